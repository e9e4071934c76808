"""One part of the suite gpu: `python -m experiments.benchmarks.gpu_process KIND ARGUMENTS`, with the arguments as JSON.

It prints each measurement as a line of `part_process`.
"""

import dataclasses
import json
import sys
from collections.abc import Callable, Iterator

import jax

from experiments.benchmarks import exact_resume, gpu_trace, kernels, part_process
from experiments.benchmarks.measure_loops import bench_loops, loop_steps
from experiments.benchmarks.measurements import (
    ERROR,
    GRAPHS,
    HOST_SYNCS,
    KERNELS,
    PROFILED_STEPS,
    Failure,
    Measurement,
)
from experiments.gymnasium_parity.trajectories import compare_steps
from experiments.surroundings import jax_settings
from sqt_jax import envs

STATES = 64  # of a comparison with MuJoCo


def loop(
    algo: str, task: str, physics: str, members: int, seconds: float, repeats: int, label: str = ""
) -> Iterator[Measurement | Failure]:
    """Environment steps per second of the training loop; `label` says how the process differs from the default."""
    for found in bench_loops(algo, task, members, [physics], seconds=seconds, repeats=repeats):
        if isinstance(found, Failure):
            yield found._replace(what=found.what + label)
        else:
            yield dataclasses.replace(found, what=found.what + label)


def parity(task: str, physics: str) -> Iterator[Measurement]:
    """The error of one control step against Gymnasium's environment, which MuJoCo computes on the CPU."""
    found = compare_steps(task, envs.make(task, physics), STATES)
    more = f"95 %: {found.qvel_95:.1e}, observation {found.obs_median:.1e}, reward {found.reward_median:.1e}"
    equal = f"terminations equal in {100 * found.terminations_agree:.0f} %"
    what = f"{task}, {physics}, a control step against MuJoCo ({more}, {equal})"
    yield Measurement(suite="parity", what=what, members=STATES, unit=ERROR, rate=found.qvel_median)


def profile(algo: str, task: str, physics: str, members: int, label: str = "") -> Iterator[Measurement]:
    """Kernels, CUDA graphs and copies to the host of a step, by the profiler."""
    prepared = loop_steps(algo, task, members, physics)
    jax.block_until_ready(prepared.run(PROFILED_STEPS))
    work = gpu_trace.count(kernels.record(prepared.run, PROFILED_STEPS))
    shares = ", ".join(f"{name} {share:.0%}" for name, share in work.longest.items())
    name = f"{algo} on {task}, {physics}{label}"
    busy = f"busy {1e3 * work.seconds / PROFILED_STEPS:.2f} ms a step: {shares}"
    counts = {KERNELS: work.kernels, GRAPHS: work.graphs, HOST_SYNCS: work.copies_to_host}
    for (unit, number), what in zip(counts.items(), (f"{name} ({busy})", name, name), strict=True):
        yield Measurement(suite="profile", what=what, members=members, unit=unit, rate=number / PROFILED_STEPS)


KINDS: dict[str, Callable[..., Iterator[Measurement | Failure]]] = {
    "loop": loop,
    "parity": parity,
    "profile": profile,
    "exact": exact_resume.compare,
}


def main(kind: str, arguments: str) -> None:
    """Makes the measurements of a part and prints them."""
    if kind != "exact":  # whose processes need the GPU's memory
        jax_settings.prepare()
        jax_settings.start_jax(1)
        jax.config.update("jax_enable_compilation_cache", False)  # compile times are measured
    for found in KINDS[kind](**json.loads(arguments)):
        print(part_process.line(found), flush=True)


if __name__ == "__main__":
    part_process.end_with_parent()
    main(*sys.argv[1:])
