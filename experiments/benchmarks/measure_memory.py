"""The peak memory of a run: `python -m experiments.bench --suites=memory --tasks=humanoid`.

Each case runs in a process of its own, because a process's peak memory never falls.
"""

import multiprocessing
import re
import resource
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from experiments.benchmarks.measurements import MEGABYTES, Measurement, member_keys
from experiments.running.checkpoints import CheckpointStore
from experiments.running.loop import Position
from experiments.surroundings import jax_settings
from sqt_jax import envs, experiment, train
from sqt_jax.config import Config
from sqt_jax.members import layout_here

STEPS = 1_000_000  # a run's default
SAVED = 25_000  # rows of a checkpoint: the default interval


class Memory(NamedTuple):
    """Memory in bytes."""

    started: int  # the process with its imports, before the first array
    peak: int  # of the process during compilation, warm-up, training, evaluation and a checkpoint
    on_device: int | None  # peak of the accelerator's memory; None on a CPU
    estimate: int  # of replay and agents, as a run prints it before it starts
    replay: int


def bench_memory(algo: str, task: str, members: int, capacity: int, physics: str) -> Iterator[Measurement]:
    """The process's peak memory and its parts; an accelerator's as a second measurement.

    Raises:
      ConfigError: an invalid setting.
    """
    config = experiment.make_config(algo, task, physics=physics, steps=max(STEPS, capacity), replay_capacity=capacity)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        found = pool.submit(_measured, config, members).result()
    case = f"{algo} on {task}, {physics}, capacity {capacity:,}"
    parts = {"before the first array": found.started, "replay": found.replay, "estimate": found.estimate}
    listed = ", ".join(f"{name} {size / 1e6:,.0f}" for name, size in parts.items())
    yield Measurement(
        suite="memory", what=f"{case}: at most ({listed})", members=members, unit=MEGABYTES, rate=found.peak / 1e6
    )
    if found.on_device:
        yield Measurement(
            suite="memory",
            what=f"{case}: at most on the device",
            members=members,
            unit=MEGABYTES,
            rate=found.on_device / 1e6,
        )


def _measured(config: Config, members: int) -> Memory:
    jax_settings.prepare()
    jax_settings.start_jax(members)
    started = _peak_bytes()
    trainer = experiment.make_trainer(config)
    replay = experiment.replay_of(config, envs.make(config.env, config.physics))
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
        peak=_peak_bytes(),
        on_device=on_device.get("peak_bytes_in_use"),
        estimate=experiment.memory_estimate(config, members),
        replay=rows,
    )


def _peak_bytes() -> int:
    """The most memory that this process has held."""
    # Not ru_maxrss on Linux: it includes the process that started this one.
    status = Path("/proc/self/status")
    peak = re.search(r"VmHWM:\s*(\d+) kB", status.read_text()) if status.exists() else None
    if peak:
        return 1024 * int(peak[1])
    unit = 1 if sys.platform == "darwin" else 1024  # ru_maxrss is in bytes on macOS, in KiB elsewhere
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
