"""Checkpoints per second: `python -m experiments.bench --suites=checkpoint --tasks=ant --members=5`."""

import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp

from experiments.benchmarks.measurements import Measurement, member_keys
from experiments.running.checkpoints import CheckpointStore
from experiments.running.loop import Position
from experiments.running.run_policies import RunPolicies
from sqt_jax import envs, experiment, train
from sqt_jax.members import layout_here

FILLED = 100_000  # rows in the replay
NEW = 25_000  # rows since the last checkpoint: the default interval


def bench_checkpoint(algo: str, task: str, members: int, repeats: int) -> Iterator[Measurement]:
    """A first checkpoint with all rows, a later one with the rows of one interval, and how long it blocks training."""
    config = experiment.make_config(algo, task, replay_capacity=FILLED)
    trainer = experiment.make_trainer(config)
    env = envs.make(task)
    replay, policies = experiment.replay_of(config, env), RunPolicies(config, env, members)
    layout = layout_here(members)
    sweep = train.make_sweep(trainer, layout)
    scalars = jax.tree.map(lambda value: jnp.full(members, value), config.agent.scalars())
    state = sweep.init(member_keys(members), scalars)
    policies.start(state.agent)
    everything, later, waits, size = [], [], [], 0
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            store = CheckpointStore(Path(folder), replay, layout, 2, print)
            save(store, state, policies, FILLED - NEW)
            waiting, complete = save(store, state, policies, FILLED)
            waits.append(waiting)
            later.append(complete)
        with tempfile.TemporaryDirectory() as folder:
            store = CheckpointStore(Path(folder), replay, layout, 2, print)
            everything.append(save(store, state, policies, FILLED)[1])
            size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())

    def measured(what: str, seconds: list[float]) -> Measurement:
        return Measurement(
            suite="checkpoint",
            what=f"{algo}, {task}, {what}",
            members=members,
            unit="checkpoints",
            rate=1 / statistics.median(seconds),
        )

    yield measured(f"all {FILLED:,} rows, {size / 1e6:,.0f} MB", everything)
    yield measured(f"{NEW:,} new rows", later)
    yield measured(f"{NEW:,} new rows, until training continues", waits)


def save(store: CheckpointStore, state: train.TrainState, policies: RunPolicies, at: int) -> tuple[float, float]:
    """Saves a checkpoint after `at` steps: the seconds until training can continue, and until it is on disk."""
    began = time.perf_counter()
    store.save(state, Position(at, at), {}, policies.writer(state.agent))
    waiting = time.perf_counter() - began
    store.wait()
    return waiting, time.perf_counter() - began
