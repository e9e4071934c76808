"""Episodes of Brax's own environments as a page of HTML: Brax's viewer, which the browser fetches from Brax's site."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from sqt_jax.types import TimeStep


class _Pose(NamedTuple):
    """What Brax's viewer looks at of a state."""

    x: Any  # a brax.Transform: where the links are


def poses(timestep: TimeStep) -> Any:
    """For `episodes.play`'s `look`: where the links are, a `brax.Transform` of pos [L, 3] and rot [L, 4]."""
    return timestep.state.task.pipeline_state.x


def page(env: Any, shown: Sequence[Any]) -> bytes:
    """Episodes one after another, in real time.

    Args:
      env: Brax's own environment (`brax_envs.brax_own`).
      shown: of each episode what `poses` gave of its states, [T, ...].
    """
    from brax.io import html

    states = [
        _Pose(jax.tree.map(lambda x, t=t: np.asarray(x[t]), episode))
        for episode in shown
        for t in range(len(episode.pos))
    ]
    # The viewer expects one state for each of the simulator's steps, of which a control step has several.
    system = env.sys.tree_replace({"opt.timestep": float(env.dt)})
    # the whole window: a height that is a number has no unit there, and counts for nothing
    return html.render(system, states, height="100vh", colab=False).encode()
