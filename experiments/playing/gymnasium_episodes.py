"""Episodes of a policy in an environment on the host, one after another, with its own pictures."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from experiments.playing.episodes import PlayedEpisode
from sqt_jax.envs import gym_spaces

FRAMES_PER_SECOND = 30.0  # of environments that do not say theirs


def play(
    env: Any, policy: Callable[[Any], Any], seed: int, limit: int, ended: Callable[[PlayedEpisode], None]
) -> Iterator[int]:
    """One episode from `reset(seed=seed)`; yields the number of steps so far in each state in which the policy acts.

    Args:
      env: a `gymnasium.Env` with the spaces that `gym_spaces` takes.
      policy: obs [1, O] -> action [1, A] in [-1, 1].
      limit: cuts the episode off.
      ended: called with the episode when it is over.
    """
    observations, actions = gym_spaces.observations(env.observation_space), gym_spaces.actions(env.action_space)
    obs, _ = env.reset(seed=seed)
    total, length, terminated, truncated = 0.0, 0, False, False
    while length < limit and not (terminated or truncated):
        yield length
        action = actions.scale(np.asarray(policy(observations.flatten(obs)[None]))[0])
        obs, reward, terminated, truncated, _ = env.step(action)
        total += float(np.asarray(reward).item())
        length += 1
    ended(PlayedEpisode(shown=None, total=total, length=length, terminated=bool(terminated), truncated=bool(truncated)))


def picture(env: Any) -> np.ndarray:
    """The environment's picture of its state: [H, W, 3] uint8, H and W even, as films need.

    Raises:
      ValueError: it gives none.
    """
    try:
        frame = env.render()
    except NotImplementedError:
        frame = None
    if not isinstance(frame, np.ndarray) or frame.ndim != 3 or frame.shape[2] < 3:
        raise ValueError("expects an environment whose render() gives pictures [H, W, 3] with render_mode='rgb_array'")
    frame = np.asarray(frame[..., :3], np.uint8)
    height, width, _ = frame.shape
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def period(env: Any) -> float:
    """Seconds between two states in a film."""
    rate = env.metadata.get("render_fps") or FRAMES_PER_SECOND
    return 1.0 / float(rate)
