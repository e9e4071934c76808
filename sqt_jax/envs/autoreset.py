"""Episodes for every task: the time limit, the automatic reset and the terminal contract.

`make_environment` is the way to an environment of your own: its docstring is the guide.

The contract of the environments it makes (one test per sentence in tests/test_autoreset.py):

- `reset` and `step` are pure; the same key and the same actions give the same episode.
- Actions are clipped to [-1, 1].
- `reward`, `terminated` and `truncated` belong to the step just made, also if it ended the episode.
- `truncated` is true at step `episode_length` of an episode and at no other.
- A step may be both terminated and truncated, as in Gymnasium; a terminated step has no value beyond it, so `discount
  = 1 - terminated`.
- After the end of an episode, `obs` and `state` are those of a new episode with a new random start, and `final_obs` is
  the true last observation of the old one.
- Elsewhere `final_obs` equals `obs`.
- A step whose reward or observation is not finite, or beyond 1e10 (the physics diverged), ends the episode: terminated,
  reward 0, and `final_obs` is the observation before it, so that every output stays finite.
- `status` counts these steps, over all episodes, as `unstable_steps`.
- `speed` is that of the step just made; after the end of an episode, that of the new start.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sqt_jax.conditional import cond_if_any
from sqt_jax.types import Array, Environment, Metrics, State, TimeStep

LARGEST = 1e10  # MuJoCo's own limit (mjMAXVAL): beyond it, a simulation has diverged
# A lower bound on the mean length of an episode that ends by a fall, in steps: under the worst constant action, hopper
# and walker fall after six (tests/test_gym_tasks.py).
MIN_STEPS_TO_FALL = 5

Start = Callable[[Array], tuple[State, Array]]
Advance = Callable[[State, Array], tuple[State, Array, Array, Array]]
Place = Callable[[Array, Array], tuple[State, Array]]


class EpisodeState(NamedTuple):
    """The state of an environment inside a `TimeStep`."""

    task: State  # the state of `start` and `advance` (for the Gymnasium tasks: a `PhysicsState`)
    steps: Array  # [] int32: steps made in this episode
    key: Array  # [] typed key: draws the starts of the next episodes
    unstable: Array  # [] int32: steps so far, over all episodes, in which the physics diverged


def make_environment(
    name: str,
    observation_size: int,
    action_size: int,
    episode_length: int,
    start: Start,
    advance: Advance,
    place: Place | None = None,
    min_mean_episode_length: int = 1,
    speed: Callable[[State], Array] | None = None,
) -> Environment:
    """Make an `Environment` from two functions of one robot or task: how an episode starts, and one step.

    A point on a line that earns more the closer it is to 0, and falls off at 2:

    >>> def start(key):
    ...     x = jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)
    ...     return x, x  # the state and the observation
    >>> def advance(x, action):
    ...     x = x + 0.1 * action
    ...     return x, x, -jnp.abs(x[0]), jnp.abs(x[0]) > 2.0
    >>> env = make_environment("point", 1, 1, 200, start, advance)

    `start` and `advance` are JAX code for a single environment, without a batch axis: training calls them under `jit`
    and `vmap`. They know nothing of episodes: `make_environment` adds the time limit, clips actions to [-1, 1] and ends
    an episode whose numbers are no longer finite. After each end it calls `start` again (the auto-reset): the time step
    then has the state and `obs` of the new episode, and the old one's last observation as `final_obs`.

    They must not have side effects, draw random numbers other than from `key` (for noise in `advance`, keep a
    key in the state and split it), branch in Python on a traced value, count the time limit, or start a new episode
    themselves. The state is any tree of arrays; it must have the same structure, shapes and dtypes from both functions.

    Args:
      name: used in messages and records.
      observation_size: O.
      action_size: A.
      episode_length: steps until the time limit truncates an episode.
      start: `key -> (state, obs [O])`, a random start of an episode. Under `vmap` it runs for all environments at each
        step at which any episode ends.
      advance: `(state, action [A] in [-1, 1]) -> (state, obs [O], reward [], terminated [] bool)`, one step.
        `terminated` means that the task is over and there is no value beyond (a fall, a goal), not that time is up.
      place: `(qpos [nq], qvel [nv]) -> (state, obs [O])`, a given physical state. It becomes
        `Environment.set_physics`, whose later episodes start from a fixed key.
      min_mean_episode_length: a memory hint, as in `Environment`; 1 is always safe.
      speed: `state -> []`, the forward speed in m/s of the step that led to the state, shown in evaluations.

    Returns:
      The environment, with the contract at the top of this module. It can be used in `sqt_jax.make_train(config,
      env=env)`.
    """

    def begin(task: State, obs: Array, key: Array, unstable: Array) -> TimeStep:
        false = jnp.zeros((), bool)
        obs = jnp.asarray(obs, jnp.float32)
        return TimeStep(
            state=EpisodeState(task=task, steps=jnp.zeros((), jnp.int32), key=key, unstable=unstable),
            obs=obs,
            reward=jnp.zeros((), jnp.float32),
            terminated=false,
            truncated=false,
            final_obs=obs,
        )

    no_steps = np.zeros((), np.int32)

    def new_episode(key: Array, unstable: Array) -> TimeStep:
        start_key, next_key = jax.random.split(key)
        return begin(*start(start_key), next_key, unstable)

    def reset(key: Array) -> TimeStep:
        return new_episode(key, jnp.asarray(no_steps))

    def restart(old: tuple[EpisodeState, Array], _: Any) -> tuple[State, Array]:
        episode, _ = old
        first = new_episode(episode.key, episode.unstable)
        return first.state, first.obs

    def step(timestep: TimeStep, action: Array) -> TimeStep:
        episode: EpisodeState = timestep.state
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
        state = EpisodeState(task=task, steps=steps, key=episode.key, unstable=unstable)
        state, obs = cond_if_any(ended, restart, (state, final_obs))
        return TimeStep(
            state=state,
            obs=obs,
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            final_obs=final_obs,
        )

    def set_physics(qpos: Array, qvel: Array) -> TimeStep:
        assert place is not None
        return begin(*place(qpos, qvel), jax.random.key(0), jnp.asarray(no_steps))

    def status(timestep: TimeStep) -> Metrics:
        return {"unstable_steps": timestep.state.unstable}

    return Environment(
        name=name,
        observation_size=observation_size,
        action_size=action_size,
        episode_length=episode_length,
        reset=reset,
        step=step,
        set_physics=set_physics if place else None,
        status=status,
        min_mean_episode_length=min_mean_episode_length,
        speed=(lambda timestep: speed(timestep.state.task)) if speed else None,
    )
