"""Inserts and samples per second of a replay buffer: `python -m experiments.bench --suites=replay`."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

from experiments.benchmarks.measurements import Case, Failure, Measurement, measure_cases, member_keys, preparing
from sqt_jax import envs, lap, replay
from sqt_jax.ring import Ring
from sqt_jax.types import Transition

BATCH = 256
REPLAYS = {"uniform": replay.uniform, "lap": lap.lap}


def bench_replay(
    kind: str, what: str, task: str, capacity: int, members: int, **timing: Any
) -> Iterator[Measurement | Failure]:
    """`what` = insert: one row; `what` = sample: one batch and its feedback; both on a full buffer."""
    return measure_cases([replay_case(kind, what, task, capacity, members)], **timing)


def replay_case(kind: str, what: str, task: str, capacity: int, members: int) -> Case:
    """The case of one kind of `REPLAYS`, with rows of a task's sizes and `capacity` rows per member."""
    label = f"{kind} {what}, {task} rows, capacity {capacity:,}"
    return Case(
        Measurement(suite="replay", what=label, members=members, unit=f"{what}s"),
        preparing(replay_steps, kind, what, task, capacity, members),
    )


def replay_steps(kind: str, what: str, task: str, capacity: int, members: int) -> Callable[[int], Any]:
    """A compiled loop: number of inserts or samples -> an array [M] to wait for."""
    env = envs.make(task)
    ring = Ring(capacity, env.observation_size, env.action_size, min_mean_episode_length=env.min_mean_episode_length)
    store = REPLAYS[kind](ring, BATCH)
    axes = store.member_axes
    obs, action, scalar = jnp.ones((1, env.observation_size)), jnp.zeros((1, env.action_size)), jnp.ones(1)
    row = Transition(obs=obs, action=action, reward=scalar, next_obs=obs, discount=scalar)

    def insert(state, total, key, step):
        return store.insert(state, row), total

    def sample(state, total, key, step):
        batch, rows = store.sample(state, key)
        state = store.feedback(state, rows, jax.random.uniform(key, (BATCH,), maxval=3.0), step + 1)
        # The sum uses the complete batch: XLA removes reads of unused values.
        return state, total + sum(map(jnp.sum, batch))

    def over_members(step_of):
        return jax.vmap(step_of, in_axes=(axes, 0, 0, None), out_axes=(axes, 0))

    def loop(step_of, state, total, keys, steps):
        def body(i, carry):
            return step_of(*carry, jax.vmap(jax.random.fold_in, (0, None))(keys, i), i)

        return jax.lax.fori_loop(0, steps, body, (state, total))

    measured = over_members({"insert": insert, "sample": sample}[what])
    run = jax.jit(functools.partial(loop, measured), donate_argnums=0)
    fill = jax.jit(functools.partial(loop, over_members(insert)), donate_argnums=0)
    keys, total = member_keys(members), jnp.zeros(members)
    state, _ = fill(jax.jit(jax.vmap(lambda _: store.init(), out_axes=axes))(keys), total, keys, capacity)

    def once(steps):
        nonlocal state
        state, total = run(state, jnp.zeros(members), keys, steps)
        return total

    return once
