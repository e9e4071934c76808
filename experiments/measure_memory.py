"""The memory that a run takes at its height: `python -m experiments.bench --suites=memory --tasks=humanoid`.

Each case is a process of its own, since a process's highest memory never falls.
"""

import multiprocessing
import resource
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from experiments import runtime
from experiments.checkpoints import Checkpoints
from experiments.loop import Position
from experiments.measure import member_keys
from sqt_jax import algorithms, envs, train
from sqt_jax.members import Layout

SAVED = 25_000  # rows of a checkpoint: the default interval's


class Memory(NamedTuple):
    """Bytes."""

    started: int  # the process with all that it imports, before the first array
    highest: int  # afterwards, at any time: compilation, warm-up, training, evaluation, a checkpoint
    device_highest: int | None  # of the accelerator, if there is one
    estimate: int  # what a run says before it begins
    replay: int  # of it the replay


def measure_memory(algo: str, task: str, members: int, capacity: int, physics: str) -> Memory:
    """All that a run does, once, in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_measured, algo, task, members, capacity, physics).result()


def _measured(algo: str, task: str, members: int, capacity: int, physics: str) -> Memory:
    runtime.prepare()
    started = _highest()
    config = algorithms.make_config(algo, task, replay_capacity=capacity, physics=physics)
    trainer, replay = algorithms.make_trainer(config), algorithms.replay_of(config, envs.make(task, physics))
    sweep = train.make_sweep(trainer)
    state = sweep.init(member_keys(members), jax.tree.map(lambda x: jnp.full(members, x), config.agent.scalars()))
    rows = sum(leaf.nbytes for leaf in jax.tree.leaves(state.replay))
    state = sweep.advance(state, 300, False)
    state = sweep.advance(state, 4, True)
    jax.block_until_ready(sweep.evaluate(state))
    with tempfile.TemporaryDirectory() as folder:
        store = Checkpoints(Path(folder), replay, Layout(members), 2, print)
        store.save(state, Position(min(SAVED, capacity), 0), {})
        store.wait()
        state = sweep.advance(state, 4, True)
    jax.block_until_ready(state.env_steps)
    on_device = jax.devices()[0].memory_stats() or {}
    return Memory(
        started=started,
        highest=_highest(),
        device_highest=on_device.get("peak_bytes_in_use"),
        estimate=algorithms.memory_estimate(config, members),
        replay=rows,
    )


def _highest() -> int:
    unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def told(memory: Memory) -> str:
    """One line."""
    device = f", on the device {memory.device_highest / 1e6:,.0f}" if memory.device_highest else ""
    return (
        f"{memory.highest / 1e6:,.0f} MB at most, of which {memory.started / 1e6:,.0f} before the first array{device}; "
        f"the replay's {memory.replay / 1e6:,.0f}, estimated before the run {memory.estimate / 1e6:,.0f}"
    )
