"""The memory that a run expects at its height: `python -m experiments.bench --suites=memory --tasks=humanoid`.

Each case is a process of its own, since a process's highest memory never falls.
"""

import multiprocessing
import resource
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from experiments.benchmarks.measure import MEGABYTES, Row, member_keys
from experiments.running import runtime
from experiments.running.checkpoints import CheckpointStore
from experiments.running.loop import Position
from sqt_jax import algorithms, envs, train
from sqt_jax.config import Config
from sqt_jax.members import layout_here

STEPS = 1_000_000  # as a run has by itself
SAVED = 25_000  # rows of a checkpoint: the default interval's


class Memory(NamedTuple):
    """Bytes."""

    started: int  # the process with all that it imports, before the first array
    highest: int  # at any time: compilation, warm-up, training, evaluation, a checkpoint
    on_device: int | None  # the same of an accelerator, where there is one
    estimate: int  # of the replay and the agents, which a run makes before it begins
    replay: int


def bench_memory(algo: str, task: str, members: int, capacity: int, physics: str) -> Iterator[Row]:
    """The process's memory at its height, and what it consists of; an accelerator's in a row of its own."""
    config = algorithms.make_config(algo, task, physics=physics, steps=max(STEPS, capacity), replay_capacity=capacity)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        found = pool.submit(_measured, config, members).result()
    case = f"{algo} on {task}, {physics}, capacity {capacity:,}"
    parts = {"before the first array": found.started, "replay": found.replay, "estimate": found.estimate}
    told = ", ".join(f"{name} {size / 1e6:,.0f}" for name, size in parts.items())
    yield Row("memory", f"{case}: at most ({told})", members, MEGABYTES, found.highest / 1e6)
    if found.on_device:
        yield Row("memory", f"{case}: at most on the device", members, MEGABYTES, found.on_device / 1e6)


def _measured(config: Config, members: int) -> Memory:
    runtime.prepare()
    runtime.set_cpu_device_count(members)
    started = _highest()
    trainer = algorithms.make_trainer(config)
    replay = algorithms.replay_of(config, envs.make(config.env, config.physics))
    layout = layout_here(members)
    sweep = train.make_sweep(trainer, layout)
    state = sweep.init(member_keys(members), jax.tree.map(lambda x: jnp.full(members, x), config.agent.scalars()))
    rows = sum(leaf.nbytes for leaf in jax.tree.leaves(state.replay))
    state = sweep.advance(state, 300, False)
    state = sweep.advance(state, 4, True)
    jax.block_until_ready(sweep.evaluate(state))
    with tempfile.TemporaryDirectory() as folder:
        store = CheckpointStore(Path(folder), replay, layout, 2, print)
        store.save(state, Position(min(SAVED, replay.capacity), 0), {})
        store.wait()
        state = sweep.advance(state, 4, True)
    jax.block_until_ready(state.env_steps)
    on_device = jax.devices()[0].memory_stats() or {}
    return Memory(
        started=started,
        highest=_highest(),
        on_device=on_device.get("peak_bytes_in_use"),
        estimate=algorithms.memory_estimate(config, members),
        replay=rows,
    )


def _highest() -> int:
    unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
