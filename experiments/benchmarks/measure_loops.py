"""Environment steps per second of the complete training loop: `python -m experiments.bench --suites=loop`."""

import functools
import time
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from experiments.benchmarks.measurements import (
    Case,
    Failure,
    Measurement,
    Prepared,
    device_counts,
    measure_cases,
    member_keys,
    with_devices,
)
from sqt_jax import experiment, train
from sqt_jax.config import Config
from sqt_jax.members import Layout
from sqt_jax.types import Array

REPLAY_ROWS = 1_000_000  # of the replays of all members together
MAX_INTERLEAVED_BYTES = 8e9  # loops that need more memory together are measured one after the other
WARMUP_STEPS = 300  # of one member, before the timed steps


def bench_loops(
    algo: str,
    task: str,
    members: int,
    physics: Sequence[str],
    devices: Sequence[int | None] = (1,),
    profiled: bool = False,
    **timing: Any,
) -> Iterator[Measurement | Failure]:
    """The training loop (environment step, insert, sample, update) on each physics and number of devices.

    The loops are interleaved, or measured one after the other if they need too much memory together.

    Args:
      devices: numbers of devices; None is the number that a run would use.
    """
    cases = [
        Case(
            Measurement(
                suite="loop",
                what=f"{algo} on {task}, {with_devices(name, count)}",
                members=members,
                unit="env steps",
                devices=count,
            ),
            functools.partial(loop_steps, algo, task, members, name, count),
        )
        for name in physics
        for count in device_counts(devices, members)
    ]
    needed = len(cases) * experiment.memory_estimate(loop_config(algo, task, members), members)
    for group in [[case] for case in cases] if needed > MAX_INTERLEAVED_BYTES else [cases]:
        yield from measure_cases(group, profiled, **timing)


def loop_config(algo: str, task: str, members: int, physics: str | None = None) -> Config:
    """The settings of a measured run: the defaults, with a smaller replay."""
    capacity = min(100_000, max(1_000, REPLAY_ROWS // members))
    return experiment.make_config(algo, task, replay_capacity=capacity, physics=physics)


def loop_steps(algo: str, task: str, members: int, physics: str, devices: int = 1) -> Prepared:
    """A loop of lockstep training steps, compiled and warmed up, and the seconds of its compilation."""
    config = loop_config(algo, task, members, physics)
    layout = Layout(members, tuple(jax.local_devices()[:devices]))
    sweep = train.make_sweep(experiment.make_trainer(config), layout)
    scalars = jax.tree.map(lambda value: jnp.full(members, value), config.agent.scalars())
    state = sweep.init(member_keys(members), scalars)
    start = time.perf_counter()
    state = sweep.advance(state, 1, False)
    state = jax.block_until_ready(sweep.advance(state, 1, True))
    compile_seconds = time.perf_counter() - start
    state = sweep.advance(state, WARMUP_STEPS, False)

    def once(steps: int) -> Array:
        nonlocal state
        state = sweep.advance(state, steps, True)
        return state.env_steps

    return Prepared(once, compile_seconds=compile_seconds)
