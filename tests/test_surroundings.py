"""What is around a run may not cost it: shells, streams, homes, file systems, batch systems, variables of libraries.

A row of `ROWS` is one surrounding: bash runs the real command in it. Rows that train are slow; they expect the tables
of a run without the surrounding, bit for bit. What cannot be made on every machine is a stand-in at the boundary of
the system (`PYTHON`: code that runs before the command's, as sitecustomize.py), and its row says so.
"""

import csv
import functools
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "experiments" / "results" / "td3_walker_100k"
TINY = (
    "--algo=td3 --env=cheetah --physics=mujoco --steps=200 --warmup_steps=100 --batch_size=16 --eval_every=100 "
    "--eval_episodes=1 --hidden=16,16 --seeds=0"
)
FUNCTIONS = """
run() { "$PYTHON" -m experiments.run "$@"; }
tables() { "$PYTHON" -m experiments.tables "$RESULTS" "$@"; }
plots() { "$PYTHON" -m experiments.plots "$RESULTS" --out="$OUT" "$@"; }
play() { "$PYTHON" -m experiments.play "$@"; }
send() { kill -$1 $(pgrep -P $!) || exit 5; }  # a signal to the run in the background
until_begun() { until ls "$OUT"/cheetah/*/*/evaluations.csv 2> /dev/null; do sleep 0.1; done; }
"""

# Stand-ins.
NO_USER = """
import pwd
def getpwuid(uid):
    raise KeyError(uid)
pwd.getpwuid = getpwuid
"""
NO_LOCKS = """
import errno, fcntl
def flock(descriptor, operation):
    raise OSError(errno.ENOLCK, "No locks available")
fcntl.flock = flock
"""
NO_SYNC = """
import errno, os
def fsync(descriptor):
    raise OSError(errno.EINVAL, "Invalid argument")
os.fsync = fsync
"""
BROKEN_FIGURES = """
import matplotlib.figure
def savefig(*arguments, **kind):
    raise RuntimeError("no font")
matplotlib.figure.Figure.savefig = savefig
"""
CLOCK_JUMPS = """
import itertools, time
now, jumps = time.time, itertools.cycle([0, 1e9, -1e8])
time.time = lambda: now() + next(jumps)
"""
NO_THREADS_FOR_CHECKPOINTS = """
import threading
start = threading.Thread.start
def refuse(thread):
    if "_write" in repr(getattr(thread, "_target", None)):
        raise RuntimeError("can't start new thread")
    start(thread)
threading.Thread.start = refuse
"""


def control_groups(**files: str) -> str:
    """Stand-in: the control groups of a job, by these files (`__` is a slash)."""
    return f"""
import pathlib
files = {{"/" + name.replace("__", "/").replace("_dot_", "."): text for name, text in {files!r}.items()}}
read_text, is_dir = pathlib.Path.read_text, pathlib.Path.is_dir
def read(path, *arguments, **kind):
    if str(path).startswith(("/sys/fs/cgroup", "/proc/self/cgroup")):
        if str(path) not in files:
            raise FileNotFoundError(2, "No such file or directory", str(path))
        return files[str(path)]
    return read_text(path, *arguments, **kind)
def is_folder(path):
    if str(path).startswith("/sys/fs/cgroup"):
        return any(name.startswith(str(path) + "/") for name in files)
    return is_dir(path)
pathlib.Path.read_text, pathlib.Path.is_dir = read, is_folder
"""


V2_NESTED = control_groups(
    proc__self__cgroup="0::/slurm/job_7/step_0\n",
    sys__fs__cgroup__slurm__job_7__memory_dot_max="300000000",
    sys__fs__cgroup__slurm__job_7__memory_dot_current="250000000",
    sys__fs__cgroup__slurm__job_7__step_0__memory_dot_max="max",
    sys__fs__cgroup__slurm__job_7__step_0__memory_dot_current="250000000",
)
V1 = control_groups(
    proc__self__cgroup="9:memory:/slurm/uid_0/job_7\n4:cpu,cpuacct:/\n",
    sys__fs__cgroup__memory__slurm__uid_0__job_7__memory_dot_limit_in_bytes="300000000",
    sys__fs__cgroup__memory__slurm__uid_0__job_7__memory_dot_usage_in_bytes="250000000",
)
QUOTA = control_groups(proc__self__cgroup="0::/\n", sys__fs__cgroup__cpu_dot_max="100000 100000")


class Row(NamedTuple):
    """One surrounding."""

    name: str
    shell: str  # bash, with the functions above, in an empty folder with HOME=home and OUT=out
    says: str = ""  # text on stdout or stderr
    code: int = 0
    variables: dict[str, str | None] = {}  # None: not set
    python: str = ""
    never: str = "Traceback"  # text that is not printed
    finishes: bool = True  # of a row that trains: whether its run ends


TRAIN = "run $TINY --out=$OUT --name=a"
LONG = "$TINY --steps=100000 --eval_every=100000 --out=$OUT --name=k"
LARGE = f"{TRAIN} --eval_every=1000000 --replay_capacity=2000000000 --steps=1000000"

# Refused in one line, or done without training.
ROWS = [
    Row("no such platform", TRAIN, "JAX_PLATFORMS=cuda: expects a platform", 2, {"JAX_PLATFORMS": "cuda"}),
    Row("debug_nans", TRAIN, "JAX_DEBUG_NANS: expects it to be off", 2, {"JAX_DEBUG_NANS": "1"}),
    Row("nobody's home as --out", "run $TINY --out=~nobody_here/runs", "--out=~nobody_here/runs: expects", 2),
    Row("no home for --out", "run $TINY --out=~/runs", "--out=~/runs: expects", 2, {"HOME": None}, NO_USER),
    Row("stand-in: memory of an outer control group", LARGE, "under memory.max of the control group job_7", 2,
        python=V2_NESTED),  # fmt: skip
    Row("ulimit -v", f"ulimit -v 9000000; {LARGE}00", "under ulimit -v", 2),
    Row("no space after -m", "\"$PYTHON\" -Xutf8 -mexperiments.run --stepz=1", "did you mean --steps", 2),
    Row("a module of one's own", "mkdir mine; echo 'import experiments' > mine/__init__.py; "
        "echo 'import os; print(os.environ[\"MUJOCO_GL\"])' > mine/train.py; \"$PYTHON\" -m mine.train", "egl", 0,
        {"MUJOCO_GL": "egl"}),  # fmt: skip
    Row("a folder that is not UTF-8", "run $TINY --out=$'caf\\xe9'", "expects a folder whose whole path is UTF-8", 2),
    Row("stdout is full", "tables > /dev/full", "could not be written: No space left", 1),
    Row("all streams are closed", "tables <&- >&- 2>&-", "", 0),
    Row("the reader of stdout leaves", "tables | true; exit ${PIPESTATUS[0]}", "", 0, never="rror"),
    Row("ASCII in files", "tables --out=$OUT", "95 %", 0,
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}),  # fmt: skip
    Row("colours, and warnings that are errors", "tables | cat", "95 %", 0,
        {"FORCE_COLOR": "1", "TERM": "dumb", "PYTHONWARNINGS": "error"}, never="\x1b"),  # fmt: skip
    Row("a notebook's matplotlib", "plots", "learning_curves.png", 0,
        {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}),  # fmt: skip
]  # fmt: skip

# The same, each much like one of `ROWS`: slow tests.
ALIKE = [
    Row("no platform at all", TRAIN, "JAX_PLATFORMS=banana: expects a platform", 2, {"JAX_PLATFORMS": "banana"}),
    Row("debug_infs", TRAIN, "JAX_DEBUG_INFS: expects it to be off", 2, {"JAX_DEBUG_INFS": "true"}),
    Row("no jit", TRAIN, "JAX_DISABLE_JIT: expects it to be off", 2, {"JAX_DISABLE_JIT": "1"}),
    Row("a switch that is no switch", TRAIN, "JAX_ENABLE_X64", 2, {"JAX_ENABLE_X64": "banana"}),
    Row("nobody's home as --config", "run --config=~nobody_here/a.yaml", "--config=~nobody_here/a.yaml: expects", 2),
    Row("nobody's home as RUNS", "\"$PYTHON\" -m experiments.tables '~nobody_here/a'", "expects a folder", 2),
    Row("stand-in: memory of a control group, version 1", LARGE, "under memory.limit_in_bytes", 2, python=V1),
    Row("ulimit -d", f"ulimit -d 9000000; {LARGE}00", "under ulimit -d", 2),
    Row("options of Python", "\"$PYTHON\" -um experiments.run --stepz=1", "did you mean --steps", 2),
    Row("an unknown MUJOCO_GL", "play $RESULTS", "expects a run with policy/", 2, {"MUJOCO_GL": "banana"}),
    Row("a sweep into a folder that cannot be", "\"$PYTHON\" -m experiments.sweep --grid=table2 --out=/proc/x",
        "--out=/proc/x: expects a folder that can be written", 2),  # fmt: skip
    Row("stderr is full", "run --stepz=1 2> /dev/full", "", 2),
    Row("stdout is closed", "tables >&-", "", 0),
    Row("ASCII, in a locale that is not there", "tables", "95 %", 0,
        {"PYTHONIOENCODING": "ascii", "LC_ALL": "xx_XX.UTF-8"}),  # fmt: skip
    Row("20 columns in a pipe", "tables | cat", "by seed   at the last one", 0, {"COLUMNS": "20"}, never="…"),
    Row("a matplotlibrc with LaTeX", "echo 'text.usetex: True' > rc; plots", "learning_curves.png", 0,
        {"MATPLOTLIBRC": "rc", "MPLBACKEND": "tkagg"}),  # fmt: skip
]  # fmt: skip

# Trained to the end, or to a checkpoint.
TRAINED = [
    Row("a notebook", TRAIN, "done", 0, {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}),
    Row("a matplotlib that is not there", TRAIN, "done", 0, {"MPLBACKEND": "nonsense"}),
    Row("stand-in: figures fail", TRAIN, "no curves.png: RuntimeError: no font", python=BROKEN_FIGURES),
    Row("stdout is full", f"{TRAIN} > /dev/full"),
    Row("stdout and stderr are full", f"{TRAIN} > /dev/full 2>&1"),
    Row("the reader leaves", f"{TRAIN} 2>&1 | head -1; exit ${{PIPESTATUS[0]}}"),
    Row("all streams are closed", f"{TRAIN} <&- >&- 2>&-"),
    Row("stdout does not block", f"{TRAIN} | \"$PYTHON\" -c 'import os, sys; os.set_blocking(0, False); "
        "import time; time.sleep(5)'; exit ${PIPESTATUS[0]}"),  # fmt: skip
    Row("ASCII", TRAIN, "done", 0, {"PYTHONIOENCODING": "ascii"}),
    Row("a narrow log", f"{TRAIN} > log; cat log", "mean +- std", 0, {"COLUMNS": "30"}, never="…"),
    Row("stand-in: no user, no home", TRAIN, "compiled programs are not kept", 0,
        {"HOME": None, "JAX_COMPILATION_CACHE_DIR": None}, NO_USER),  # fmt: skip
    Row("a home that is not there", TRAIN, "compiled programs are not kept", 0,
        {"HOME": "/nonexistent", "JAX_COMPILATION_CACHE_DIR": None}),  # fmt: skip
    Row("a cache that cannot be written", TRAIN, "compiled programs are not kept", 0,
        {"JAX_COMPILATION_CACHE_DIR": "/proc/cache"}),  # fmt: skip
    Row("a cache in ~", f"{TRAIN} && ls home/cache", "", 0, {"JAX_COMPILATION_CACHE_DIR": "~/cache"}),
    Row("--out in ~", "run $TINY --out=~/runs --name=a && mv home/runs $OUT", "done"),
    Row("stand-in: no locks", TRAIN, "has no locks (No locks available)", python=NO_LOCKS),
    Row("stand-in: no fsync", TRAIN, "no events for TensorBoard", python=NO_SYNC),
    Row("x64", TRAIN, "JAX_ENABLE_X64: has no effect", 0, {"JAX_ENABLE_X64": "1"}),
    Row("other random numbers", TRAIN, "JAX_DEFAULT_PRNG_IMPL", 0, {"JAX_DEFAULT_PRNG_IMPL": "rbg"}),
    Row("an offset of seeds", TRAIN, "JAX_RANDOM_SEED_OFFSET", 0, {"JAX_RANDOM_SEED_OFFSET": "7"}),
    Row("strict promotion", TRAIN, "has no effect", 0,
        {"JAX_NUMPY_DTYPE_PROMOTION": "strict", "JAX_NUMPY_RANK_PROMOTION": "raise"}),  # fmt: skip
    Row("no transfers", TRAIN, "done", 0, {"JAX_TRANSFER_GUARD": "disallow"}),
    Row("other checks of JAX", TRAIN, "done", 0,
        {"JAX_CHECK_TRACER_LEAKS": "1", "JAX_DEBUG_KEY_REUSE": "1", "JAX_ENABLE_CHECKS": "1"}),  # fmt: skip
    Row("a number of devices", f"{TRAIN} --devices=1", "done", 0, {"JAX_NUM_CPU_DEVICES": "3"}),
    Row("a number of devices for XLA", f"{TRAIN} --devices=1", "done", 0,
        {"XLA_FLAGS": "--xla_force_host_platform_device_count=3"}),  # fmt: skip
    Row("an unknown MUJOCO_GL", TRAIN, "done", 0, {"MUJOCO_GL": "banana"}),
    Row("warnings are errors", TRAIN, "done", 0, {"PYTHONWARNINGS": "error"}),
    Row("no asserts, no docstrings", TRAIN, "done", 0, {"PYTHONOPTIMIZE": "2"}),
    Row("a path without the current folder", TRAIN, "done", 0, {"PYTHONSAFEPATH": "1"}),
    Row("no TMPDIR, no time zone", TRAIN, "done", 0, {"TMPDIR": "/nonexistent", "TZ": "Nowhere/Nowhere"}),
    Row("a live line in a file", f"{TRAIN} > log; cat log", "done", 0, {"FORCE_COLOR": "1"}, never="\x1b"),
    Row("YAML's no", "echo 'name: no' > a.yaml; run $TINY --config=a.yaml --out=$OUT", "cheetah/td3/no"),
    Row("stand-in: a clock that jumps", TRAIN, "done", python=CLOCK_JUMPS),
    Row("stand-in: no threads for checkpoints", TRAIN, "done", python=NO_THREADS_FOR_CHECKPOINTS),
    Row("few open files", f"ulimit -Sn 64; {TRAIN}", "done"),
    Row("nohup and a terminal that closes", f"trap '' HUP; {TRAIN} & until_begun; send HUP; wait $!", "done"),
    Row("stopped and continued", f"{TRAIN} & until_begun; send STOP; sleep 3; send CONT; wait $!", "done"),
    Row("killed, then played", f"run {LONG} --checkpoint_every=200 & "
        "until ls -d $OUT/cheetah/td3/k/checkpoint/step_*[0-9]; do sleep 0.2; done; send 9; "
        "play $OUT/cheetah/td3/k --steps=5", "checkpoint at step", finishes=False),  # fmt: skip
    *(
        Row(f"SIG{name}", f"run {LONG} & until_begun; sleep 3; send {name}; wait $!; code=$?; "
            "ls -d $OUT/cheetah/td3/k/checkpoint/step_* || exit 6; exit $code", "resume with", 130, finishes=False)
        for name in ("HUP", "USR1", "USR2", "XCPU", "TERM", "INT")
    ),
]  # fmt: skip


def in_surroundings(row: Row, folder: Path, timeout: float = 300) -> subprocess.CompletedProcess[str]:
    """Runs the row's shell in the folder, for at most `timeout` seconds."""
    (folder / "home").mkdir(exist_ok=True)
    variables = os.environ | {
        "PYTHON": sys.executable,
        "RESULTS": str(RESULTS),
        "TINY": TINY,
        "OUT": "out",
        "HOME": str(folder / "home"),
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(ROOT),
    }
    if row.python:
        (folder / "stand_in").mkdir()
        (folder / "stand_in" / "sitecustomize.py").write_text(row.python)
        variables["PYTHONPATH"] = f"{folder / 'stand_in'}:{ROOT}"
    for name, value in row.variables.items():
        variables |= {name: value or ""}
        if value is None:
            variables.pop(name)
    return subprocess.run(
        ["bash", "-c", FUNCTIONS + row.shell],
        cwd=folder,
        env=variables,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=timeout,
    )


def check(row: Row, done: subprocess.CompletedProcess[str]) -> None:
    text = done.stdout + done.stderr
    assert done.returncode == row.code, text
    assert row.says in text, text
    assert row.never not in text, text


def table(folder: Path, algo: str = "td3") -> list[dict[str, str]]:
    with next((folder / "out" / "cheetah" / algo).glob("*/evaluations.csv")).open() as file:
        return [{name: value for name, value in row.items() if name != "wall_seconds"} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The evaluations of a run without any surrounding."""
    folder = tmp_path_factory.mktemp("undisturbed")
    row = Row("none", TRAIN, "done")
    check(row, in_surroundings(row, folder))
    return table(folder)


@pytest.mark.parametrize(
    "row", [*ROWS, *(pytest.param(row, marks=pytest.mark.slow) for row in ALIKE)], ids=lambda row: row.name
)
def test_a_command_ends_as_it_should(row, tmp_path):
    done = in_surroundings(row, tmp_path, timeout=60)
    check(row, done)
    if row.code == 2:
        assert done.stderr.count("\n") <= 1 and not (tmp_path / "out").exists(), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("row", TRAINED, ids=lambda row: row.name)
def test_a_run_is_not_lost(row, tmp_path, undisturbed):
    if row.name == "SIGHUP" and signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
        pytest.skip("the tests run under nohup")
    check(row, in_surroundings(row, tmp_path))
    if row.finishes:
        assert table(tmp_path) == undisturbed
        path = next((tmp_path / "out" / "cheetah" / "td3").iterdir())
        assert (path / "policy" / "member_0.npz").exists() and (path / "summary.json").exists()
        assert (path / "curves.png").exists() == ("figures" not in row.name)
        assert not {item.name for item in tmp_path.iterdir()} & {"~", "false"}


SMALL_DISK = """
mkdir disk && mount -t tmpfs -o size=4m none disk || exit 77
trap "umount disk" EXIT
head -c 4000k /dev/zero > disk/filler
run $TINY --out=disk --name=a --checkpoint_every=100; [ $? = 1 ] || exit 5
rm disk/filler && run --resume=disk/cheetah/$ALGO/a && cp -r disk $OUT
"""
HARDSHIPS = {
    "limits": Row("limits", f"ulimit -v 12000000; ulimit -n 48; ulimit -f 2000; {TRAIN}", "done"),
    "a full disk": Row("a full disk", SMALL_DISK, "the results cannot be written"),
    "stopped": next(row for row in TRAINED if row.name == "stopped and continued"),
    "clock": next(row for row in TRAINED if row.name == "stand-in: a clock that jumps"),
}


@pytest.fixture(scope="module")
def undisturbed_sqt(tmp_path_factory):
    """The evaluations of a run of an algorithm without any surrounding."""

    @functools.cache
    def run(algo: str) -> list[dict[str, str]]:
        folder = tmp_path_factory.mktemp(algo)
        check(Row("none", TRAIN, "done"), in_surroundings(of_algorithm(Row("none", TRAIN, "done"), algo), folder))
        return table(folder, algo)

    return run


def of_algorithm(row: Row, algo: str) -> Row:
    return row._replace(variables=row.variables | {"ALGO": algo, "TINY": TINY.replace("td3", algo)})


@pytest.mark.slow
@pytest.mark.parametrize("hardship", HARDSHIPS)
@pytest.mark.parametrize("algo", ["td3_sqt", "sac_sqt", "td7_sqt"])
def test_sqt_trains_through(algo, hardship, tmp_path, undisturbed_sqt):
    row = of_algorithm(HARDSHIPS[hardship], algo)
    done = in_surroundings(row, tmp_path)
    if done.returncode == 77:
        pytest.skip("a small disk can be mounted by root only")
    check(row, done)
    assert table(tmp_path, algo) == undisturbed_sqt(algo)


@pytest.mark.slow
def test_two_jobs_of_one_second_with_long_settings_have_folders_of_their_own(tmp_path, undisturbed):
    row = Row("two jobs", "run $TINY --out=$OUT & one=$!; run $TINY --out=$OUT & wait $! && wait $one", "done")
    check(row, in_surroundings(row, tmp_path))
    assert len(list((tmp_path / "out" / "cheetah" / "td3").glob("*/summary.json"))) == 2


@pytest.mark.slow
def test_a_run_resumed_with_other_cores_says_so(tmp_path, undisturbed):
    """Stand-in: a quota of one core; the run was started with as many as the machine has, or one more."""
    row = Row("cores", f"{TRAIN} --checkpoint_every=100", "done")
    check(row, in_surroundings(row, tmp_path))
    config = tmp_path / "out" / "cheetah" / "td3" / "a" / "config.json"
    content = json.loads(config.read_text())
    assert content["device"]["devices"] == 1 and content["device"]["cores"] >= 1
    config.write_text(json.dumps(content | {"device": content["device"] | {"cores": 999}}))
    row = Row("again", "run --resume=$OUT/cheetah/td3/a --steps=300", "cores 999 -> 1", python=QUOTA)
    check(row, in_surroundings(row, tmp_path))
