"""Throughput of each part: `python -m experiments.bench --suites=env,update,loop --members=1,5`.

`--suite=gpu` and `--suite=growth` are such command lines by name: what a GPU is measured by, and how cost grows.
`--compare=sbx` adds another project's whole loop on the same machine, in turns with ours (`benchmarks.compare`).

Operations are those of the matrix products, and their peak is measured in the same run (`operations`).
Each figure is the median over `--repeats` timed calls of a compiled loop that runs for about `--seconds`, after a
first call that compiles. The suites of one process run one after the other; compare figures of one run only, since a
machine's speed changes with what else it does. But for this: where a processor is made many devices (`--devices=auto`
of many members), as many threads share the operations of each, of a program on one device too, and slow it down.
Compare one device with one for each member by commands that follow one another.

What fails is told in a line that begins with `failed`, and the rest is measured; the exit code is 1 then. `--json` is
written anew with every row.
"""

import dataclasses
import itertools
import json
import os
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
from absl import app, flags, logging
from rich.console import Console
from rich.table import Table

from experiments.benchmarks import compare, growth, kernels, operations
from experiments.benchmarks.measure import (
    REPLAYS,
    Failure,
    Row,
    bench_env,
    bench_loops,
    bench_physics,
    bench_replay,
    bench_updates,
    on,
    why,
)
from experiments.benchmarks.measure_checkpoints import bench_checkpoint
from experiments.benchmarks.measure_memory import bench_memory
from experiments.commandline import arguments
from experiments.evidence.published import PAPERS_TASKS
from experiments.running import files, runtime
from sqt_jax import algorithms, envs

SUITES = ("env", "physics", "update", "replay", "loop", "checkpoint")  # what is measured if nothing is said
MORE_SUITES = ("growth", "memory")
# Command lines by name: flags of this program, which those that are given win over.
NAMED: dict[str, dict[str, Any]] = {
    "gpu": {
        "suites": ["loop"],
        "algos": ["td3", "td7"],
        "tasks": ["ant", "humanoid"],
        "members": ["5", "64", "512"],
        "devices": ["1", "auto"],
        "profile": True,
    },
    "growth": {"suites": ["growth"], "tasks": ["cheetah"], "members": ["5"]},
}
FLAGS = flags.FLAGS
flags.DEFINE_list("suites", list(SUITES), f"What to measure: {', '.join(SUITES + MORE_SUITES)}.")
flags.DEFINE_enum("suite", None, list(NAMED), "Flags by name, which those that are given win over.")
flags.DEFINE_list("tasks", list(PAPERS_TASKS), "Tasks; the suite replay expects the rows of the first one.")
flags.DEFINE_list("physics", None, "Physics of the suites env, loop and memory; by itself all that can run here.")
flags.DEFINE_list("solver", [], "Further limits of MJX's solver in the suite physics: iterations/line-search steps.")
flags.DEFINE_list("algos", ["td3", "sac", "td7"], "Algorithms of the suites update, loop and memory.")
flags.DEFINE_list("members", ["1", "5"], "Numbers of members.")
flags.DEFINE_list(
    "devices",
    ["auto"],
    "Devices that the suites update and loop spread their members over: numbers, or auto, as a run.",
)
flags.DEFINE_list("capacities", ["10000", "1000000"], "Capacities of the suites replay and memory.")
flags.DEFINE_boolean("profile", False, "Also count and time what the suite loop runs on the device.")
flags.DEFINE_string("figures", "bench", "Folder of the suite growth's figures.")
flags.DEFINE_list("compare", [], f"Peers to measure beside ours, in turns: {', '.join(compare.NEEDS)}.")
flags.DEFINE_string("peer_python", sys.executable, "The Python that has the peers' packages.")
flags.DEFINE_integer("repeats", 5, "Timed calls per figure; the median counts.", lower_bound=1)
flags.DEFINE_float("seconds", 1.0, "About how long one timed call runs.", lower_bound=0.0)
flags.DEFINE_string("json", "", "Also write the rows to this file.")


def check_flags() -> None:
    """Leaves with one line that names the first flag with a value that cannot be."""
    for name, value in NAMED.get(FLAGS.suite, {}).items():
        if not FLAGS[name].present:
            FLAGS[name].value = value
    for name in ("tasks", "algos", "members", "devices", "capacities", "physics"):
        if FLAGS[name].value == []:  # of the suites alone none may be asked for, beside --compare
            sys.exit(f"--{name}: expects at least one")
    known = {
        "suites": SUITES + MORE_SUITES,
        "compare": compare.NEEDS,
        "tasks": envs.TASKS,
        "algos": algorithms.ALGORITHMS,
        "physics": envs.PHYSICS,
    }
    for name, values in known.items():
        for value in getattr(FLAGS, name) or ():
            if value not in values:
                sys.exit(f"--{name}: expects some of {', '.join(values)}, not {value!r}")
    for name in ("members", "devices", "capacities"):
        for value in getattr(FLAGS, name):
            if not (value.isdecimal() and int(value)) and (name, value) != ("devices", "auto"):
                sys.exit(f"--{name}: expects whole numbers of at least 1, not {value!r}")
    solver_limits()
    if "growth" in FLAGS.suites and len(FLAGS.members) != 1:
        sys.exit(f"--members: expects one number where growth is measured, not {','.join(FLAGS.members)}")
    if FLAGS.json and (Path(FLAGS.json).is_dir() or not Path(FLAGS.json).absolute().parent.is_dir()):
        sys.exit(f"--json: expects a file in a folder that is there, not {FLAGS.json!r}")
    if "growth" in FLAGS.suites:
        with leaving():
            arguments.reject_folder("--figures", Path(FLAGS.figures))
    for peer in FLAGS.compare:
        if not {*compare.ALGORITHMS[peer]} & {*FLAGS.algos}:
            sys.exit(f"--algos: expects some of {', '.join(compare.ALGORITHMS[peer])} with --compare={peer}")
        if compare.lacks(peer, FLAGS.peer_python):
            sys.exit(f"--compare: {peer} needs a Python with {compare.INSTALL[peer]}; --peer_python names it")


@contextmanager
def leaving() -> Iterator[None]:
    """Leaves with the line of a `UsageError`."""
    try:
        yield
    except arguments.UsageError as error:
        sys.exit(str(error))


def solver_limits() -> dict[str, dict[str, int]]:
    """--solver: each of its values -> MJX's options; leaves with one line where one cannot be."""
    found = {}
    for value in FLAGS.solver:
        numbers = value.split("/")
        if len(numbers) != 2 or not all(number.isdecimal() and int(number) for number in numbers):
            sys.exit(f"--solver: expects pairs of whole numbers of at least 1 as in 8/8, not {value!r}")
        found[value] = dict(zip(("iterations", "ls_iterations"), map(int, numbers), strict=True))
    return found


def physics_here() -> list[str]:
    """--physics; leaves with one line where the machine lacks what one of them needs."""
    for name in FLAGS.physics or ():
        if missing := envs.lacks(name):
            sys.exit(f"--physics: {name} needs {missing}")
    return FLAGS.physics or [name for name in envs.PHYSICS if not envs.lacks(name)]


def devices_here() -> list[int | None]:
    """--devices, `auto` as None; leaves with one line where one is more than there are."""
    here = len(jax.local_devices())
    counts = [None if value == "auto" else int(value) for value in FLAGS.devices]
    if most := max((count for count in counts if count and count > here), default=None):
        sys.exit(f"--devices: expects at most {here} here, not {most}")
    return counts


def most_devices() -> int:
    """How many a run of the largest sweep here would make of a processor."""
    numbers = [int(value) for value in FLAGS.devices if value != "auto"]
    if "auto" in FLAGS.devices or FLAGS.compare:
        numbers += map(int, FLAGS.members)
    if "growth" in FLAGS.suites:
        numbers += growth.MEMBERS
    return max(numbers)


def rows(
    suites: Sequence[str], physics: Sequence[str], environment: Mapping[str, str], **timing: Any
) -> Iterator[Row | Failure]:
    """What the flags ask for; `environment` is that of the peers' processes."""
    for what, found in parts(suites, physics, environment, **timing):
        try:
            yield from found
        except Exception as error:
            yield Failure(what, why(error))


def parts(
    suites: Sequence[str], physics: Sequence[str], environment: Mapping[str, str], **timing: Any
) -> Iterator[tuple[str, Iterator[Row | Failure]]]:
    """The measurements, each of which goes on when another fails, and what to call them then."""
    tasks, algos, devices = FLAGS.tasks, FLAGS.algos, devices_here()
    members = [int(value) for value in FLAGS.members]
    for suite, count in itertools.product(suites, members):
        if suite == "env":
            for task, name in itertools.product(tasks, physics):
                yield f"env: {task}, {name}", bench_env(task, count, name, **timing)
        elif suite == "physics":
            for task in tasks:
                yield f"physics: {task}", bench_physics(task, count, solver_limits(), **timing)
        elif suite == "update":
            for algo, task in itertools.product(algos, tasks):
                yield f"update: {algo}, {task}", bench_updates(algo, task, count, devices, **timing)
        elif suite == "replay":
            for kind, what, size in itertools.product(REPLAYS, ("insert", "sample"), map(int, FLAGS.capacities)):
                yield f"replay: {kind} {what}", bench_replay(kind, what, tasks[0], size, count, **timing)
        elif suite == "memory":
            for algo, task, name, size in itertools.product(algos, tasks, physics, map(int, FLAGS.capacities)):
                yield f"memory: {algo} on {task}, {name}", bench_memory(algo, task, count, size, name)
        elif suite == "checkpoint":
            for algo, task in itertools.product(algos, tasks):
                yield f"checkpoint: {algo}, {task}", bench_checkpoint(algo, task, count, timing["repeats"])
        elif suite == "loop":
            for algo, task in itertools.product(algos, tasks):
                loops = bench_loops(algo, task, count, physics, devices, FLAGS.profile, **timing)
                yield f"loop: {algo} on {task}", loops
    if "growth" in suites:
        yield "growth", growth.rows(algos, tasks[0], members[0], **timing)
    for peer, count, algo, task in itertools.product(FLAGS.compare, members, algos, tasks):
        if algo in compare.ALGORITHMS[peer]:
            both = compare.compare(peer, algo, task, count, physics, FLAGS.peer_python, environment, **timing)
            yield f"compare: {algo} on {task}, {peer}", both


def machine() -> dict[str, Any]:
    """What the figures depend on."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        cpu = f"{len(names)} x {names[0]}" if names else cpu
    device = jax.devices()[0]
    kind = f"{device.platform}: {device.device_kind}"
    return {"cpu": cpu, "device": kind, "devices": len(jax.devices()), "jax": jax.__version__}


# Of the suites physics and loop: what is measured against what.
AGAINST = {
    ("physics", "mujoco"): "MuJoCo alone",
    ("physics", "mjx"): "mjx, the file's iterations",
    ("loop", "mujoco"): "mjx",
    ("loop", "warp"): "mjx",
}


def ratios(all_rows: Sequence[Row]) -> list[str]:
    """What these suites are for: each physics against MuJoCo alone, MJX against the file's settings, whole loops."""
    rates = {(r.suite, r.what, r.members): r for r in all_rows}
    lines = []
    for (suite, what, members), row in rates.items():
        on_devices = on("", row.devices)
        task, _, physics = what.removesuffix(on_devices).partition(", ")
        reference = AGAINST.get((suite, physics), "")
        if other := rates.get((suite, f"{task}, {reference}{on_devices}", members)):
            ratio = row.rate / other.rate
            lines.append(f"{task}, {members} members{on_devices}: {physics} / {reference} = {ratio:.2f}")
    return lines


HEADER = ("suite", "what", "members", "rate", "unit", "compile s", "GFLOP", "of the peak", "operations a step")


def cells(row: Row, peak: float) -> tuple[str, ...]:
    """The row under `HEADER`; empty is what was not measured."""
    compiled = "" if row.compile_seconds is None else f"{row.compile_seconds:.1f}"
    counted = f"{row.operations / 1e9:.3g}" if row.operations else ""
    peak *= 1 if jax.default_backend() == "cpu" else row.devices  # of one device; a CPU's have the same cores
    share = f"{row.rate * row.operations / peak:.0%}" if row.operations and peak else ""
    profiled = f"{sum(kind.number for kind in row.kinds):,.0f}" if row.kinds else ""
    return (row.suite, row.what, str(row.members), *row.figure, compiled, counted, share, profiled)


def markdown(all_rows: Sequence[Row], peak: float) -> str:
    lines = [HEADER, ("---",) * len(HEADER), *(cells(row, peak) for row in all_rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def tell(found: Row | Failure) -> None:
    if isinstance(found, Failure):
        print(f"failed: {found.what}: {found.why}", flush=True)
        return
    print(f"{found.suite}: {found.what}, {found.members} members: {' '.join(found.figure)}", flush=True)
    if found.kinds is not None:
        print(f"  {kernels.told(found.kinds, found.members / found.rate)}", flush=True)


def save(found: Sequence[Row], failed: Sequence[Failure], peak: float) -> None:
    """--json; leaves with one line where it cannot be written."""
    if not FLAGS.json:
        return
    report = {"machine": machine(), "peak": peak, "rows": [dataclasses.asdict(row) for row in found]}
    report["failed"] = [failure._asdict() for failure in failed]
    try:
        with files.atomic_file(Path(FLAGS.json)) as file:
            file.write((json.dumps(report, indent=1) + "\n").encode())
    except OSError as error:
        sys.exit(f"--json={FLAGS.json}: expects a file that can be written: {error.strerror}")


def show(found: Sequence[Row], peak: float) -> None:
    """All rows as tables and figures."""
    table = Table(*HEADER, title="median of repeats")
    for row in found:
        table.add_row(*cells(row, peak))
    Console().print(table)
    print(markdown(found, peak))
    print("\n".join(ratios(found) + compare.ratios(found)))
    try:
        for path in growth.draw(found, Path(FLAGS.figures)):
            print(path)
    except OSError as error:
        sys.exit(f"--figures={FLAGS.figures}: expects a folder that can be written: {error.strerror}")


def main(argv: Sequence[str]) -> None:
    del argv
    check_flags()
    logging.set_verbosity(logging.WARNING)
    if FLAGS.compare:  # several processes share an accelerator's memory: none may take most of it in advance
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    environment = dict(os.environ)  # before our own options for XLA are in it
    runtime.prepare()
    runtime.set_cpu_device_count(most_devices())
    jax.config.update("jax_enable_compilation_cache", False)  # compile times are figures here
    print(", ".join(f"{key}: {value}" for key, value in machine().items()), flush=True)
    devices_here()
    physics = physics_here()
    for name in () if FLAGS.physics else envs.PHYSICS:
        if missing := envs.lacks(name):
            print(f"without {name}, which needs {missing}", flush=True)
    found: list[Row] = []
    failed: list[Failure] = []
    peak = 0.0
    try:
        for row in rows(FLAGS.suites, physics, environment, seconds=FLAGS.seconds, repeats=FLAGS.repeats):
            tell(row)
            if isinstance(row, Failure):
                failed.append(row)
            else:
                found.append(row)
            save(found, failed, peak)
        if any(row.operations for row in found):
            try:
                peak = operations.peak(seconds=FLAGS.seconds, repeats=FLAGS.repeats)
                print(f"peak of matrix products: {peak / 1e9:,.0f} GFLOP/s", flush=True)
            except Exception as error:
                failed.append(Failure("peak of matrix products", why(error)))
                tell(failed[-1])
            save(found, failed, peak)
    finally:  # what was measured until somebody stopped it
        show(found, peak)
    if failed:
        sys.exit(f"{len(failed)} failed: the lines that begin with `failed` say what, and why")


if __name__ == "__main__":
    app.run(main)
