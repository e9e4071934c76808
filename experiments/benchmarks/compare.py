"""This project against other implementations on the same machine: `python -m experiments.bench --compare=sbx`.

A peer trains one seed per process. Several seeds are trained one after the other or as processes in parallel; both are
measured, interleaved with ours. Parallel processes share the cores among them.
"""

import functools
import os
import statistics
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from typing import Any

import jax

from experiments.benchmarks.measure_loops import loop_steps
from experiments.benchmarks.measure_updates import updates
from experiments.benchmarks.measurements import Case, Failure, Measurement, Prepared, measure_cases
from experiments.benchmarks.peer_process import PeerProcesses
from experiments.benchmarks.ratio import ratio_text
from sqt_jax import envs
from sqt_jax.envs import gym_table
from sqt_jax.job_limits import usable_cores
from sqt_jax.members import usable_devices

NEEDS = {"sbx": "sbx", "torch": "torch"}  # the package that a peer's program imports
INSTALL = {"sbx": "sbx-rl (pip install sbx-rl)", "torch": "torch (pip install torch)"}
ALGORITHMS = {"sbx": ("td3", "sac"), "torch": ("td7",)}  # the algorithms of ours that a peer has too
UNITS = {"sbx": "env steps", "torch": "member updates"}
PER_CORE = 2  # processes at most


def lacks(peer: str, interpreter: str) -> bool:
    """Whether `interpreter` does not run, or cannot import the package that the peer needs."""
    try:
        return subprocess.run([interpreter, "-c", f"import {NEEDS[peer]}"], capture_output=True).returncode != 0
    except OSError:
        return True


def peer_environment() -> dict[str, str]:
    """Environment variables for the peers' processes. Call before JAX starts and before `jax_settings.prepare`.

    Afterwards neither the peers nor this process allocate an accelerator's memory in advance, since they share it.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    return dict(os.environ)


def process_counts(members: int) -> list[int]:
    """The numbers of parallel processes to measure: one, one per core, and one per member (at most two per core)."""
    cores = usable_cores()
    return sorted({1, min(members, cores), min(members, PER_CORE * cores)})


def rate_of_all(seeds: int, processes: int, rates: Mapping[int, float]) -> float:
    """Steps per second of all seeds, trained in rounds of `processes` in parallel and a last round of the rest.

    Args:
      rates: number of parallel processes -> steps per second of one of them.
    """
    rounds, rest = divmod(seeds, processes)
    seconds = rounds / rates[processes] + (1 / rates[rest] if rest else 0.0)  # for one step of each seed
    return seeds / seconds


def compare(
    peer: str,
    algo: str,
    task: str,
    members: int,
    physics: Sequence[str],
    interpreter: str,
    environment: Mapping[str, str],
    **timing: Any,
) -> Iterator[Measurement | Failure]:
    """Measures one algorithm: SBX's training loop against ours on each physics; PyTorch's update against ours.

    Args:
      members: number of seeds to train.
      interpreter: the Python with the packages that the peer imports.
      environment: environment variables of the peer's processes.
      timing: `seconds` and `repeats` of `timing.measure`.
    """

    def measurement(name: str, count: int, rates: tuple[float, ...] = (), devices: int = 1) -> Measurement:
        return Measurement(
            suite="compare",
            what=f"{algo} on {task}, {name}",
            members=count,
            unit=UNITS[peer],
            rate=statistics.median(rates) if rates else 0.0,
            rates=rates,
            devices=devices,
        )

    devices = usable_devices(members)  # of ours, as in a run
    if peer == "sbx":
        program, arguments = "sbx_loop.py", [algo, gym_table.TASKS[task].gymnasium_id]
        ours = [
            Case(
                measurement(f"sqt_jax, {name}", members, devices=devices),
                functools.partial(loop_steps, algo, task, members, name, devices),
            )
            for name in physics
        ]
    else:
        env = envs.make(task)
        device = "cpu" if jax.default_backend() == "cpu" else "cuda"  # as ours
        program, arguments = "torch_td7.py", [str(env.observation_size), str(env.action_size), device]
        update = functools.partial(updates, algo, task, members, devices)
        ours = [Case(measurement("sqt_jax", members, devices=devices), update)]
    counts = process_counts(members)
    rests = {members % count for count in counts} - {0}
    rates: dict[int, list[float]] = {}  # of one process, in each repeat, by the number of parallel processes
    with ExitStack() as stack:

        def start(count: int) -> Prepared:
            peers = PeerProcesses(interpreter, program, arguments, count, environment)
            return Prepared(stack.enter_context(closing(peers)))

        theirs = [
            Case(measurement(_label(peer, count), count), functools.partial(start, count))
            for count in sorted({*counts, *rests})
        ]
        for found in measure_cases([*ours, *theirs], **timing):
            if isinstance(found, Failure) or "sqt_jax" in found.what:
                yield found
            else:
                rates[found.members] = [rate / found.members for rate in found.rates]
    for count in counts:
        if {count, members % count} - {0} <= rates.keys():
            name = peer if members == 1 else _label(peer, count)
            repeats = [dict(zip(rates, row, strict=True)) for row in zip(*rates.values(), strict=True)]
            yield measurement(name, members, tuple(rate_of_all(members, count, repeat) for repeat in repeats))


def _label(peer: str, processes: int) -> str:
    return f"{peer}, {processes} processes" if processes > 1 else f"{peer}, one after the other"


def ratios(measurements: Sequence[Measurement]) -> list[str]:
    """A line per measurement of ours: its ratio to the peer's best for the same algorithm, task and members."""
    lines = []
    compared = [found for found in measurements if found.suite == "compare"]
    for found in compared:
        case, _, name = found.what.partition(", ")
        if name.startswith("sqt_jax"):
            theirs = [
                other
                for other in compared
                if other.members == found.members and other.what.startswith(f"{case}, ") and "sqt_jax" not in other.what
            ]
            if theirs:
                best = max(theirs, key=lambda other: other.rate)
                ratio = ratio_text(found, best)
                lines.append(f"{found.what}, {found.members} members / {best.what.partition(', ')[2]} = {ratio}")
    return lines
