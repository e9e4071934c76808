"""Environments on the host: Gymnasium's, whose episodes cannot be part of the compiled program.

The program calls the host once a step, for all environments of a device's members together. The contract is that of
`autoreset`, a test per sentence (tests/test_host.py), with these differences:

- `terminated` and `truncated` are the environment's own.
- `reset` and `step` are not pure: an `Environment` plays one batch of episodes at a time on each device, and a step has
  to follow the newest one. `Host.separate` gives another environment, whose episodes are its own.
- A start is drawn by `env.reset(seed=...)`, with a seed made of the time step's key and the steps made since.
- A checkpoint does not contain the running episodes: `Host.restart` begins new ones.
- An action that is not a number is not shown to the environment; the step counts as unstable.
- After an exception in an environment, `Host.failed` is true for all time steps, their numbers are 0, and their
  episodes terminate; `Host.error` is the exception. Other devices stop at their next step. `reset` tries again.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

from sqt_jax.envs import gym_spaces
from sqt_jax.envs.host_episodes import CALL_WORDS, DeviceEpisodes
from sqt_jax.envs.host_rows import LocalRows, Make, Rows, Steps
from sqt_jax.members import device_index
from sqt_jax.types import Array, Environment, Host, Metrics, TimeStep


class HostState(NamedTuple):
    """The state of an environment on the host inside a `TimeStep`: what the next call needs."""

    key: Array  # [2] uint32: drawn from the key of `reset`; it draws all starts
    steps: Array  # [] uint32: steps made since `reset`, over all episodes and processes
    call: Array  # [2] uint32: the number of the call that made this time step, and of its row
    failed: Array  # [] bool
    unstable: Array  # [] int32: as in `autoreset.EpisodeState`
    unstable_starts: Array  # [] int32


def host_environment(
    name: str, make: Callable[..., Any], episode_length: int, processes: int = 0, version: str = ""
) -> Environment:
    """An `Environment` whose episodes are played by Gymnasium environments.

    Args:
      name: used in messages and records.
      make: makes one Gymnasium environment; called once for each that plays in parallel. With `processes`, it is
        pickled. `Host.make` passes keyword arguments to it.
      episode_length: the environment's time limit, in steps.
      processes: how many processes share the environments; 0: this one plays them all.
      version: as in `Environment`.

    Raises:
      ValueError: `gym_spaces` rejects the observation or action space, or `processes` is negative.
      Exception: that of `make`.
    """
    if processes < 0:
        raise ValueError(f"processes: expected at least 0, got {processes}")
    sizes = _sizes(make)
    if processes:
        from sqt_jax.envs import host_processes

        host_processes.start_server()  # here, in the main thread

    def make_rows(count: int) -> Rows:
        if processes == 0:
            return LocalRows(make, count)
        return host_processes.ProcessRows(make, count, processes, sizes)

    def environment(family: list[DeviceEpisodes]) -> Environment:
        """An environment with episodes of its own, which join those of its family."""
        episodes = DeviceEpisodes(make_rows, *sizes)
        family.append(episodes)
        functions = episode_functions(episodes)

        def close() -> None:
            for member in family:
                member.close()

        host = Host(
            restart=functions.restart,
            failed=lambda timestep: timestep.state.failed,
            error=lambda: next((member.error for member in family if member.error), None),
            separate=lambda: environment(family),
            close=close,
            processes=processes,
            make=make,
        )
        return Environment(
            name=name,
            observation_size=sizes[0],
            action_size=sizes[1],
            episode_length=episode_length,
            reset=functions.reset,
            step=functions.step,
            status=status,
            version=version,
            host=host,
        )

    return environment([])


def _sizes(make: Make) -> tuple[int, int]:
    """O and A. Raises ValueError."""
    env = make()
    try:
        return gym_spaces.observations(env.observation_space).size, gym_spaces.actions(env.action_space).size
    finally:
        env.close()


class EpisodeFunctions(NamedTuple):
    """`reset` and `step` of an `Environment`, and `Host.restart`."""

    reset: Callable[[Array], TimeStep]
    step: Callable[[TimeStep, Array], TimeStep]
    restart: Callable[[TimeStep], TimeStep]


def episode_functions(episodes: DeviceEpisodes) -> EpisodeFunctions:
    """The functions of one environment that play `episodes` through calls to the host."""
    observation_size = episodes.observation_size
    shape = jax.ShapeDtypeStruct((episodes.out_words,), jnp.uint32)
    start_on_host, step_on_host = _callback(episodes.start, shape), _callback(episodes.step, shape)

    def words(*parts: Array) -> Array:
        return jnp.concatenate([device_index().astype(jnp.uint32)[None], *parts])

    def timestep_of(out: Array, before: HostState) -> TimeStep:
        packed = jax.lax.bitcast_convert_type(out[CALL_WORDS + 1 :], jnp.float32)
        steps = Steps.of(packed, observation_size)
        state = before._replace(
            call=out[:CALL_WORDS],
            failed=out[CALL_WORDS] > 0,
            unstable=before.unstable + steps.unstable.astype(jnp.int32),
            unstable_starts=before.unstable_starts + steps.unstable_starts.astype(jnp.int32),
        )
        return TimeStep(
            state=state,
            obs=steps.obs,
            reward=steps.reward,
            terminated=steps.terminated > 0,
            truncated=steps.truncated > 0,
            final_obs=steps.final_obs,
        )

    def start(state: HostState) -> TimeStep:
        timestep = timestep_of(start_on_host(words(state.key, state.steps[None])), state)
        return timestep._replace(terminated=jnp.zeros((), bool))  # a start ends no episode, a failed one neither

    def reset(key: Array) -> TimeStep:
        state = HostState(
            key=jax.random.bits(key, (2,), jnp.uint32),
            steps=jnp.zeros((), jnp.uint32),
            call=jnp.zeros(CALL_WORDS, jnp.uint32),
            failed=jnp.zeros((), bool),
            unstable=jnp.zeros((), jnp.int32),
            unstable_starts=jnp.zeros((), jnp.int32),
        )
        return start(state)

    def step(timestep: TimeStep, action: Array) -> TimeStep:
        state: HostState = timestep.state
        state = state._replace(steps=state.steps + 1)
        action = jnp.clip(jnp.asarray(action, jnp.float32), -1, 1)
        bits = jax.lax.bitcast_convert_type(action, jnp.uint32)
        return timestep_of(step_on_host(words(state.call, state.key, state.steps[None], bits)), state)

    return EpisodeFunctions(reset=reset, step=step, restart=lambda timestep: start(timestep.state))


def status(timestep: TimeStep) -> Metrics:
    """The counts of `HostState`, [] each."""
    return {"unstable_steps": timestep.state.unstable, "unstable_starts": timestep.state.unstable_starts}


def _callback(play: Callable[[np.ndarray], np.ndarray], shape: Any) -> Callable[[Array], Array]:
    """A function of words [W] uint32 that calls the host once for a whole batch, in order and with its side effects."""

    def in_place(context: Any, out: Any, words: Any) -> None:
        del context
        np.asarray(out)[...] = play(np.asarray(words))

    # As in `mujoco_c`: NumPy's view of the buffers is fast, and touches no JAX.
    on_cpu = buffer_callback(in_place, shape, has_side_effect=True, vmap_method="broadcast_all")

    def elsewhere(words: Array) -> Array:
        # Called as often as the program likes: `Episodes` answers a repeated call without playing it again.
        return jax.pure_callback(lambda x: play(np.asarray(x)), shape, words, vmap_method="broadcast_all")

    return lambda words: jax.lax.platform_dependent(words, cpu=on_cpu, default=elsewhere)
