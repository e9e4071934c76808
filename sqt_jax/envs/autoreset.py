"""Episodes: the time limit, the automatic restart and the terminal contract, written once for every task.

The contract (one test per sentence in tests/test_envs.py):

- `reset` and `step` are pure; the same key and the same actions give the same episode.
- Actions are clipped to [-1, 1].
- `reward`, `terminated` and `truncated` belong to the step that was just made, also where it ended the episode.
- `truncated` is true at step `episode_length` of an episode and at no other. A step may be both terminated and
  truncated, as in Gymnasium; there is no value beyond a terminated step, so `discount = 1 - terminated`.
- After an ended episode `obs` and `state` are those of a new episode with a new random start, and `final_obs` is the
  true last observation of the old one. Elsewhere `final_obs` equals `obs`.
- A step whose reward or observation is not finite, or beyond 1e10 (diverged physics), ends the episode as terminated
  with reward 0; its `final_obs` is the observation before it, so that nothing that is not finite leaves an environment.
- `status` counts such steps, as `unstable_steps`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sqt_jax.conditional import cond_if_any
from sqt_jax.types import Array, Environment, Metrics, State, TimeStep

LARGEST = 1e10  # MuJoCo's own limit (mjMAXVAL): beyond it, a simulation has diverged
# Fewer steps than a robot that may fall needs for it: by the worst constant action at their limits, hopper and walker
# do in six (tests/test_gym_tasks.py).
SHORTEST_FALL = 5

Start = Callable[[Array], tuple[State, Array]]
Advance = Callable[[State, Array], tuple[State, Array, Array, Array]]
Place = Callable[[Array, Array], tuple[State, Array]]


class Episode(NamedTuple):
    """The state of an environment inside a `TimeStep`."""

    task: State  # what the task's own functions carry (for the Gymnasium tasks: a `PhysicsState`)
    steps: Array  # [] int32: steps made in this episode
    key: Array  # [] typed key: draws the starts of the episodes after this one
    unstable: Array  # [] int32: steps so far, of all episodes, in which the physics diverged


def make_environment(
    name: str,
    observation_size: int,
    action_size: int,
    episode_length: int,
    start: Start,
    advance: Advance,
    place: Place | None = None,
    min_mean_episode_length: int = 1,
) -> Environment:
    """Make an `Environment` out of a task that knows nothing of episodes.

    Args:
      start: `key -> (state, obs [O])`, a random start. Under `vmap` it runs for all at each step at which any episode
        ends.
      advance: `(state, action [A] in [-1, 1]) -> (state, obs [O], reward [], terminated [] bool)`, one step.
      place: `(qpos, qvel) -> (state, obs [O])`, a given physical state; gives `Environment.set_physics`, whose
        episodes to come start from a fixed key.
      min_mean_episode_length: as in `Environment`.
    """

    def begin(task: State, obs: Array, key: Array, unstable: Array) -> TimeStep:
        no = jnp.zeros((), bool)
        obs = jnp.asarray(obs, jnp.float32)
        episode = Episode(task, jnp.zeros((), jnp.int32), key, unstable)
        return TimeStep(episode, obs, jnp.zeros((), jnp.float32), no, no, obs)

    none = np.zeros((), np.int32)

    def fresh(key: Array, unstable: Array) -> TimeStep:
        start_key, next_key = jax.random.split(key)
        return begin(*start(start_key), next_key, unstable)

    def reset(key: Array) -> TimeStep:
        return fresh(key, jnp.asarray(none))

    def restart(old: tuple[Episode, Array], _: Any) -> tuple[State, Array]:
        episode, _ = old
        first = fresh(episode.key, episode.unstable)
        return first.state, first.obs

    def step(timestep: TimeStep, action: Array) -> TimeStep:
        episode: Episode = timestep.state
        task, obs, reward, terminated = advance(episode.task, jnp.clip(action, -1, 1))
        obs, reward = jnp.asarray(obs, jnp.float32), jnp.asarray(reward, jnp.float32)
        finite = (jnp.abs(reward) < LARGEST) & jnp.all(jnp.abs(obs) < LARGEST)  # false for NaN too
        reward = jnp.where(finite, reward, 0)
        final_obs = jnp.where(finite, obs, timestep.obs)
        terminated = jnp.asarray(terminated, bool) | ~finite
        steps = episode.steps + 1
        unstable = episode.unstable + (~finite).astype(jnp.int32)
        truncated = steps >= episode_length

        ended = terminated | truncated
        state, obs = cond_if_any(ended, restart, (Episode(task, steps, episode.key, unstable), final_obs))
        return TimeStep(state, obs, reward, terminated, truncated, final_obs)

    def set_physics(qpos: Array, qvel: Array) -> TimeStep:
        assert place is not None
        return begin(*place(qpos, qvel), jax.random.key(0), jnp.asarray(none))

    def status(timestep: TimeStep) -> Metrics:
        return {"unstable_steps": timestep.state.unstable}

    given = set_physics if place else None
    return Environment(
        name, observation_size, action_size, episode_length, reset, step, given, status, min_mean_episode_length
    )
