"""The suites of the benchmark: which measurements belong to each."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from experiments.benchmarks import compare, growth, measure_gpu
from experiments.benchmarks.measure_batches import bench_batches
from experiments.benchmarks.measure_checkpoints import bench_checkpoint
from experiments.benchmarks.measure_envs import bench_env, bench_physics
from experiments.benchmarks.measure_kernels import bench_kernels
from experiments.benchmarks.measure_loops import bench_loops
from experiments.benchmarks.measure_memory import bench_memory
from experiments.benchmarks.measure_replays import REPLAYS, bench_replay
from experiments.benchmarks.measure_starts import bench_starts
from experiments.benchmarks.measure_updates import bench_updates
from experiments.benchmarks.measurements import Failure, Measurement, error_line

SUITES = ("env", "physics", "update", "replay", "loop", "checkpoint")  # measured by default
MORE_SUITES = ("growth", "memory", "batches", "kernels", "starts", "gpu")


class Request(NamedTuple):
    """The requested measurements; fields are the benchmark's flags of the same names, parsed."""

    suites: Sequence[str]
    tasks: Sequence[str]
    algos: Sequence[str]
    physics: Sequence[str]
    compiled_physics: Sequence[str]  # of the suite kernels
    solver: Mapping[str, dict[str, int]]  # name -> MJX's options
    members: Sequence[int]
    devices: Sequence[int | None]  # None: as a run chooses
    capacities: Sequence[int]
    profile: bool
    parts: Sequence[str]  # of the suite gpu
    patience: float
    minutes: float  # of the suite gpu
    compare: Sequence[str]
    peer_python: str


def measure_all(request: Request, environment: Mapping[str, str], **timing: Any) -> Iterator[Measurement | Failure]:
    """Makes all measurements one after the other. A suite's part that raises yields a `Failure`; the next follows.

    Args:
      environment: environment variables of the peers' processes.
      timing: `seconds` and `repeats` of `timing.measure`.
    """
    for what, measurements in itertools.chain(
        _suites(request, timing),
        _gpu(request, timing),
        _growth(request, timing),
        _comparisons(request, environment, timing),
    ):
        try:
            yield from measurements
        except Exception as error:
            yield Failure(what, error_line(error))


Part = tuple[str, Iterator[Measurement | Failure]]  # its name in a failure; its measurements, not yet made


def _suites(request: Request, timing: dict[str, Any]) -> Iterator[Part]:
    tasks, algos, physics, capacities = request.tasks, request.algos, request.physics, request.capacities
    for suite, members in itertools.product(request.suites, request.members):
        if suite == "env":
            for task, name in itertools.product(tasks, physics):
                yield f"env: {task}, {name}", bench_env(task, members, name, **timing)
        elif suite == "physics":
            for task in tasks:
                yield f"physics: {task}", bench_physics(task, members, request.solver, **timing)
        elif suite == "update":
            for algo, task in itertools.product(algos, tasks):
                yield f"update: {algo}, {task}", bench_updates(algo, task, members, request.devices, **timing)
        elif suite == "replay":
            for kind, what, capacity in itertools.product(REPLAYS, ("insert", "sample"), capacities):
                yield f"replay: {kind} {what}", bench_replay(kind, what, tasks[0], capacity, members, **timing)
        elif suite == "memory":
            for algo, task, name, capacity in itertools.product(algos, tasks, physics, capacities):
                yield f"memory: {algo} on {task}, {name}", bench_memory(algo, task, members, capacity, name)
        elif suite == "batches":
            for algo, task, name in itertools.product(algos, tasks, physics):
                yield f"batches: {algo} on {task}, {name}", bench_batches(algo, task, members, name)
        elif suite == "starts":
            for algo, task, name in itertools.product(algos, tasks, physics):
                yield f"starts: {algo} on {task}, {name}", bench_starts(algo, task, members, name)
        elif suite == "kernels":
            for algo, task, name in itertools.product(algos, tasks, request.compiled_physics):
                yield f"kernels: {algo} on {task}, {name}", bench_kernels(algo, task, members, name)
        elif suite == "checkpoint":
            for algo, task in itertools.product(algos, tasks):
                yield f"checkpoint: {algo}, {task}", bench_checkpoint(algo, task, members, timing["repeats"])
        elif suite == "loop":
            for algo, task in itertools.product(algos, tasks):
                loops = bench_loops(algo, task, members, physics, request.devices, request.profile, **timing)
                yield f"loop: {algo} on {task}", loops


def _gpu(request: Request, timing: dict[str, Any]) -> Iterator[Part]:
    if "gpu" in request.suites:
        parts = measure_gpu.parts_of(request.parts, request.tasks[0], request.members, request.physics, **timing)
        yield "gpu", measure_gpu.bench_gpu(parts, request.patience, request.minutes)


def _growth(request: Request, timing: dict[str, Any]) -> Iterator[Part]:
    if "growth" in request.suites:
        measurements = growth.measure_growth(request.algos, request.tasks[0], request.members[0], **timing)
        yield "growth", measurements


def _comparisons(request: Request, environment: Mapping[str, str], timing: dict[str, Any]) -> Iterator[Part]:
    cases = itertools.product(request.compare, request.members, request.algos, request.tasks)
    for peer, members, algo, task in cases:
        if algo in compare.ALGORITHMS[peer]:
            measurements = compare.compare(
                peer, algo, task, members, request.physics, request.peer_python, environment, **timing
            )
            yield f"compare: {algo} on {task}, {peer}", measurements
