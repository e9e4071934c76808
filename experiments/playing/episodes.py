"""Episodes of a policy, state by state: their returns, and the states for a film."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sqt_jax import rollout
from sqt_jax.types import Array, Environment, TimeStep

CHUNK = 50  # steps per call: few enough for a live line, enough to make the calls' cost negligible


class PlayedEpisode(NamedTuple):
    """One episode of T steps."""

    shown: Any  # a pytree of [T, ...]: `look` of each state in which the policy acted
    total: float  # the undiscounted return
    length: int  # T
    terminated: bool  # by the task
    truncated: bool  # by its time limit; if neither: cut off by `max_steps`


class _Running(NamedTuple):
    number: Array  # [] int32: steps so far
    timestep: TimeStep  # [E, ...]
    running: Array  # [E] bool
    totals: Array  # [E]
    lengths: Array  # [E]
    terminated: Array  # [E] bool: how the episode ended
    truncated: Array  # [E] bool


def play(
    env: Environment,
    policy: rollout.Policy,
    look: Callable[[TimeStep], Any],
    key: Array,
    num_episodes: int = 1,
    max_steps: int | None = None,
    watch: Callable[[int], None] = lambda steps: None,
) -> list[PlayedEpisode]:
    """Runs E episodes in parallel, each to its own end, from the same starts as `evaluate` with this key.

    Args:
      policy: obs [E, O] -> action [E, A] in [-1, 1].
      look: time step of one environment -> a pytree of arrays to keep.
      num_episodes: E.
      max_steps: cuts episodes off; None is the environment's time limit.
      watch: called after each chunk with the steps of the longest episode so far.
    """
    limit = min(max_steps or env.episode_length, env.episode_length)

    def body(state: _Running, _: None) -> tuple[_Running, Any]:
        shown = jax.vmap(look)(state.timestep)
        following, transition = rollout.step(env, state.timestep, policy)
        running = state.running
        number = state.number + 1
        ended = following.terminated | following.truncated | (number >= limit)
        made = _Running(
            number=number,
            timestep=following,
            running=running & ~ended,
            totals=state.totals + jnp.where(running, transition.reward, 0.0),
            lengths=state.lengths + running,
            terminated=state.terminated | (running & following.terminated),
            truncated=state.truncated | (running & following.truncated),
        )
        return made, shown

    part = jax.jit(lambda state: jax.lax.scan(body, state, length=min(CHUNK, limit)))
    none = jnp.zeros(num_episodes, bool)
    timestep = jax.jit(lambda key: rollout.reset(env, key, num_episodes))(key)
    state = _Running(
        number=jnp.zeros((), jnp.int32),
        timestep=timestep,
        running=~none,
        totals=jnp.zeros(num_episodes),
        lengths=jnp.zeros(num_episodes, jnp.int32),
        terminated=none,
        truncated=none,
    )
    parts = []
    while bool(state.running.any()):
        state, shown = part(state)
        parts.append(jax.device_get(shown))
        watch(min(int(state.number), limit))
    shown = jax.tree.map(lambda *pieces: np.concatenate(pieces), *parts)
    return [
        PlayedEpisode(
            shown=jax.tree.map(lambda x, i=i, length=length: x[:length, i], shown),
            total=float(state.totals[i]),
            length=int(length),
            terminated=bool(state.terminated[i]),
            truncated=bool(state.truncated[i]),
        )
        for i, length in enumerate(np.asarray(state.lengths))
    ]


def configuration(timestep: TimeStep) -> tuple[Array, Array]:
    """For `look`: qpos [nq] and qvel [nv] of one of Gymnasium's tasks, on any physics."""
    return timestep.state.task.qpos, timestep.state.task.qvel


def ending(episode: PlayedEpisode) -> str:
    """How the episode ended, in words."""
    if episode.terminated:
        return "terminated by the task"
    return "ended by the time limit" if episode.truncated else "cut off"
