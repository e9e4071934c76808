"""The command line of the benchmark: its flags, their check, and the request that they make.

Each function that checks exits with one line that names the flag and what it expects.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
from absl import flags

from experiments.benchmarks import compare, gpu_target, growth, measure_gpu, measure_kernels
from experiments.benchmarks.suites import MORE_SUITES, SUITES, Request
from experiments.commandline import arguments
from experiments.commandline.path_flags import define_path
from experiments.evidence.published import PAPERS_TASKS
from sqt_jax import algorithms, envs

# --suite: flags by name, which flags on the command line override.
NAMED_SUITES: dict[str, dict[str, Any]] = {
    "gpu": {
        "suites": ["gpu"],
        "tasks": ["ant"],
        "members": ["25", "100", "250"],
        "physics": list(measure_gpu.PHYSICS),
        "devices": ["1"],
        "seconds": 2.0,
        "repeats": 3,
    },
    "growth": {"suites": ["growth"], "tasks": ["cheetah"], "members": ["5"]},
}
FLAGS = flags.FLAGS
flags.DEFINE_list("suites", list(SUITES), f"What to measure: {', '.join(SUITES + MORE_SUITES)}.")
flags.DEFINE_enum(
    "suite",
    None,
    list(NAMED_SUITES),
    "A named set of flags: gpu (all to be known about a GPU in 15 minutes) or growth (cost over members, critics and "
    "capacity). Flags on the command line override it.",
)
flags.DEFINE_list("tasks", list(PAPERS_TASKS), "Tasks. The suites replay, growth and gpu use only the first one.")
flags.DEFINE_list(
    "physics",
    None,
    "Physics of the suites env, loop, memory, batches, starts, kernels and gpu. Default: every physics of this machine "
    "(kernels, which needs no GPU: mjx and warp; --suite=gpu: all).",
)
flags.DEFINE_list("solver", [], "More limits of MJX's solver for the suite physics: iterations/line-search steps.")
flags.DEFINE_list("algos", ["td3", "sac", "td7"], "Algorithms of all suites except env, physics and replay.")
flags.DEFINE_list(
    "members",
    ["1", "5"],
    "Numbers of members. With --suite=gpu up to three: of all parts, of MuJoCo C's largest loop, of Warp's.",
)
flags.DEFINE_list(
    "devices", ["auto"], "Numbers of devices for the members of the suites update and loop; auto: as in a run."
)
flags.DEFINE_list("capacities", ["10000", "1000000"], "Capacities of the suites replay and memory.")
flags.DEFINE_boolean("profile", False, "Also count and time the device operations of the suite loop.")
flags.DEFINE_boolean("peak", True, "Also measure the peak of matrix products, which updates are compared with.")
flags.DEFINE_list(
    "parts", list(measure_gpu.PARTS), f"Parts of the suite gpu, made in this order: {', '.join(measure_gpu.PARTS)}."
)
flags.DEFINE_float("patience", 1.0, "Factor of the limits of time of these parts, for a slow machine.", lower_bound=0.0)
flags.DEFINE_float(
    "minutes", measure_gpu.MINUTES, "Minutes of all these parts together; the last ones are left out.", lower_bound=0.0
)
define_path("figures", "bench", "Folder of the suite growth's figures.")
flags.DEFINE_list(
    "compare", [], f"Other implementations to measure, interleaved with ours: {', '.join(compare.NEEDS)}."
)
define_path("peer_python", sys.executable, "The Python that has the packages --compare needs.")
flags.DEFINE_integer("repeats", 5, "Timed calls per measurement, of which the median is reported.", lower_bound=1)
flags.DEFINE_float("seconds", 1.0, "Approximate seconds of one timed call.", lower_bound=0.0)
define_path("json", "", "Also write the measurements to this file, again after each of them.")


def check_flags() -> None:
    """Applies --suite, then checks every flag that can be checked without starting JAX."""
    for name, value in NAMED_SUITES.get(FLAGS.suite, {}).items():
        if not FLAGS[name].present:
            FLAGS[name].value = value
    for name in ("tasks", "algos", "members", "devices", "capacities", "physics", "parts"):
        if FLAGS[name].value == []:  # only --suites may be empty, next to --compare
            sys.exit(f"--{name}: expects at least one")
    known = {
        "suites": SUITES + MORE_SUITES,
        "compare": compare.NEEDS,
        "tasks": envs.TASKS,
        "algos": algorithms.ALGORITHMS,
        "physics": envs.PHYSICS,
        "parts": measure_gpu.PARTS,
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
        sys.exit(f"--members: expects one number with the suite growth, not {','.join(FLAGS.members)}")
    if "gpu" in FLAGS.suites and len(FLAGS.members) > 3:
        sys.exit(f"--members: expects at most three numbers with --suite=gpu, not {','.join(FLAGS.members)}")
    if "kernels" in FLAGS.suites:
        check_kernels()
    if FLAGS.json and (Path(FLAGS.json).is_dir() or not Path(FLAGS.json).absolute().parent.is_dir()):
        sys.exit(f"--json: expects a file in an existing folder, not {FLAGS.json!r}")
    if "growth" in FLAGS.suites:
        with exit_on_usage_error():
            arguments.reject_folder("--figures", Path(FLAGS.figures))
    for peer in FLAGS.compare:
        if not {*compare.ALGORITHMS[peer]} & {*FLAGS.algos}:
            sys.exit(f"--algos: expects some of {', '.join(compare.ALGORITHMS[peer])} with --compare={peer}")
        if compare.lacks(peer, FLAGS.peer_python):
            sys.exit(f"--compare: {peer} needs a Python with {compare.INSTALL[peer]}; --peer_python names it")


def check_kernels() -> None:
    """Checks what the suite kernels needs: JAX's CUDA plugin, and physics that do not call the host."""
    if gpu_target.lacks_plugin():
        sys.exit("--suites: kernels expects JAX's CUDA plugin (no GPU is needed): pip install -e '.[kernels]'")
    for name in FLAGS.physics or ():
        if name not in measure_kernels.PHYSICS:
            sys.exit(f"--physics: expects some of {', '.join(measure_kernels.PHYSICS)} with kernels, not {name!r}")


@contextmanager
def exit_on_usage_error() -> Iterator[None]:
    """Exits with the line of a `UsageError`."""
    try:
        yield
    except arguments.UsageError as error:
        sys.exit(str(error))


def solver_limits() -> dict[str, dict[str, int]]:
    """--solver: each value -> MJX's options `iterations` and `ls_iterations`."""
    found = {}
    for value in FLAGS.solver:
        numbers = value.split("/")
        if len(numbers) != 2 or not all(number.isdecimal() and int(number) for number in numbers):
            sys.exit(f"--solver: expects pairs of whole numbers of at least 1 as in 8/8, not {value!r}")
        found[value] = dict(zip(("iterations", "ls_iterations"), map(int, numbers), strict=True))
    return found


def physics_here() -> list[str]:
    """--physics, by default every physics that can run on this machine; none if no suite runs one."""
    if FLAGS.suites == ["kernels"] and not FLAGS.compare:
        return []
    for name in FLAGS.physics or ():
        if missing := envs.lacks(name):
            others = ",".join(other for other in FLAGS.physics if other != name)
            without = f"; --physics={others} leaves it out" if others else ""
            sys.exit(f"--physics: {name} needs {missing}{without}")
    return FLAGS.physics or [name for name in envs.PHYSICS if not envs.lacks(name)]


def installed(physics: str) -> bool:
    """Whether the packages of a physics are installed, whatever the machine."""
    return physics != "warp" or find_spec("warp") is not None


def devices_here() -> list[int | None]:
    """--devices, with None for `auto`. Starts JAX."""
    available = len(jax.local_devices())
    counts = [None if value == "auto" else int(value) for value in FLAGS.devices]
    if most := max((count for count in counts if count and count > available), default=None):
        sys.exit(f"--devices: expects at most {available} here, not {most}")
    return counts


def most_devices() -> int:
    """The largest number of devices that a measurement can use, for `jax_settings.start_jax`."""
    numbers = [int(value) for value in FLAGS.devices if value != "auto"]
    if "auto" in FLAGS.devices or FLAGS.compare:
        numbers += map(int, FLAGS.members)
    if "growth" in FLAGS.suites:
        numbers += growth.MEMBERS
    return max(numbers)


def request() -> Request:
    """The measurements that the flags ask for, on this machine. Starts JAX."""
    return Request(
        suites=FLAGS.suites,
        tasks=FLAGS.tasks,
        algos=FLAGS.algos,
        physics=physics_here(),
        compiled_physics=FLAGS.physics or [name for name in measure_kernels.PHYSICS if installed(name)],
        solver=solver_limits(),
        members=[int(value) for value in FLAGS.members],
        devices=devices_here(),
        capacities=[int(value) for value in FLAGS.capacities],
        profile=FLAGS.profile,
        parts=FLAGS.parts,
        patience=FLAGS.patience,
        minutes=FLAGS.minutes,
        compare=FLAGS.compare,
        peer_python=FLAGS.peer_python,
    )
