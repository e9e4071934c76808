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
- A start whose observation is not finite, or beyond 1e10, is replaced by the last finite start of this environment.
- As long as there is none, and in `set_physics`, the numbers of such an observation that are not finite become 0.
- `status` counts these starts as `unstable_starts`.
- `speed` is that of the step just made; after the end of an episode, that of the new start.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

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
    start_key: Array  # [] typed key: of the last finite start, which replaces one that is not
    unstable: Array  # [] int32: steps so far, over all episodes, in which the physics diverged
    unstable_starts: Array  # [] int32: starts so far whose observation was not finite


def in_range(x: Array) -> Array:
    """Which numbers are finite and not beyond `LARGEST`: a bool for each."""
    return jnp.abs(x) < LARGEST  # false for NaN too


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
    then has the state and `obs` of the new episode, and the old one's last observation as `final_obs`. A start that is
    not finite is replaced by the last one that was.

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

    # `jit` here and around `step`: JAX then traces once for the warm-up, training and each `vmap` around a restart.
    @jax.jit
    def begin(key: Array) -> tuple[State, Array]:
        task, obs = start(key)
        return task, jnp.asarray(obs, jnp.float32)

    def first_timestep(task: State, obs: Array, key: Array, start_key: Array) -> TimeStep:
        finite = in_range(obs)
        obs = jnp.where(finite, obs, 0)
        false = jnp.zeros((), bool)
        state = EpisodeState(
            task=task,
            steps=jnp.zeros((), jnp.int32),
            key=key,
            start_key=start_key,
            unstable=jnp.zeros((), jnp.int32),
            unstable_starts=(~jnp.all(finite)).astype(jnp.int32),
        )
        return TimeStep(
            state=state,
            obs=obs,
            reward=jnp.zeros((), jnp.float32),
            terminated=false,
            truncated=false,
            final_obs=obs,
        )

    def reset(key: Array) -> TimeStep:
        start_key, next_key = jax.random.split(key)
        task, obs = begin(start_key)
        return first_timestep(task, obs, next_key, start_key)

    def restart(old: tuple[EpisodeState, Array], _: Any) -> tuple[EpisodeState, Array]:
        episode, last_obs = old
        start_key, next_key = jax.random.split(episode.key)

        # The second attempt computes the last finite start again, and is rare: a second state of the task would be
        # carried through all steps. A loop, because two calls of `begin` would be compiled twice.
        def attempt(made: tuple[Array, Array, State, Array]) -> tuple[Array, Array, State, Array]:
            attempts, *_ = made
            task, obs = begin(jnp.where(attempts == 0, start_key, episode.start_key))
            return attempts + 1, jnp.all(in_range(obs)), task, obs

        def goes_on(made: tuple[Array, Array, State, Array]) -> Array:
            attempts, finite, *_ = made
            return (attempts < 2) & ~finite

        none = jnp.zeros((), jnp.int32), jnp.zeros((), bool), episode.task, last_obs
        attempts, _, task, obs = jax.lax.while_loop(goes_on, attempt, none)
        finite = attempts == 1
        state = EpisodeState(
            task=task,
            steps=jnp.zeros((), jnp.int32),
            key=next_key,
            start_key=jnp.where(finite, start_key, episode.start_key),
            unstable=episode.unstable,
            unstable_starts=episode.unstable_starts + (~finite).astype(jnp.int32),
        )
        return state, jnp.where(in_range(obs), obs, 0)

    def step(timestep: TimeStep, action: Array) -> TimeStep:
        episode: EpisodeState = timestep.state
        task, obs, reward, terminated = advance(episode.task, jnp.clip(action, -1, 1))
        obs, reward = jnp.asarray(obs, jnp.float32), jnp.asarray(reward, jnp.float32)
        finite = in_range(reward) & jnp.all(in_range(obs))
        reward = jnp.where(finite, reward, 0)
        final_obs = jnp.where(finite, obs, timestep.obs)
        terminated = jnp.asarray(terminated, bool) | ~finite
        steps = episode.steps + 1
        unstable = episode.unstable + (~finite).astype(jnp.int32)
        truncated = steps >= episode_length

        ended = terminated | truncated
        state = episode._replace(task=task, steps=steps, unstable=unstable)
        with jax.named_scope("restart"):
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
        task, obs = place(qpos, qvel)
        return first_timestep(task, jnp.asarray(obs, jnp.float32), jax.random.key(0), start_key=jax.random.key(1))

    def status(timestep: TimeStep) -> Metrics:
        return {"unstable_steps": timestep.state.unstable, "unstable_starts": timestep.state.unstable_starts}

    return Environment(
        name=name,
        observation_size=observation_size,
        action_size=action_size,
        episode_length=episode_length,
        reset=reset,
        step=jax.jit(step),
        set_physics=set_physics if place else None,
        status=status,
        min_mean_episode_length=min_mean_episode_length,
        speed=(lambda timestep: speed(timestep.state.task)) if speed else None,
    )
