"""Episodes of Brax's own environments as a page of HTML with Brax's viewer, which the browser fetches."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from sqt_jax.types import TimeStep


class _Pose(NamedTuple):
    """The part of a state that Brax's viewer uses."""

    x: Any  # a brax.Transform: the links' poses


def poses(timestep: TimeStep) -> Any:
    """For `episodes.play`'s `look`: the links' poses, a `brax.Transform` of pos [L, 3] and rot [L, 4]."""
    return timestep.state.task.pipeline_state.x


def page(env: Any, shown: Sequence[Any]) -> bytes:
    """The page, encoded: episodes one after another, in real time.

    Args:
      env: Brax's own environment (`brax_envs.brax_own`).
      shown: the `poses` of each episode, [T, ...].
    """
    from brax.io import html  # only here: it imports all of Brax

    states = [
        _Pose(jax.tree.map(lambda x, t=t: np.asarray(x[t]), episode))
        for episode in shown
        for t in range(len(episode.pos))
    ]
    # The viewer expects one state per simulator step; a control step has several of them.
    system = env.sys.tree_replace({"opt.timestep": float(env.dt)})
    # full window height; the viewer ignores a number, which has no unit
    return html.render(system, states, height="100vh", colab=False).encode()
