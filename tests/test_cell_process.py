"""A cell's process: its log, how it ended, signals, and that it dies with its starter."""

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.launchers import cell_process
from experiments.launchers.cell import Cell, Ended, read_ended
from experiments.launchers.cell_process import CellProcess
from experiments.running import folder_lock

ROOT = Path(__file__).resolve().parent.parent
PYTHON = sys.executable
CELL = Cell(task="ant", algo="td3", path=Path(), command=("--steps=5",))


def write_python(path, script):
    """A stand-in for Python that runs a shell script, except for `tied.py`, which stays itself."""
    path.write_text(f'#!/bin/sh\ncase "$1" in *tied.py) exec {PYTHON} "$@";; esac\n{script}\n')
    path.chmod(0o755)


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Starts a cell's process that is a shell script instead of a training."""

    def make(script, **options):
        python = tmp_path / "python"
        write_python(python, f'echo "$@" > {tmp_path}/args\n{script}')
        monkeypatch.setattr(sys, "executable", str(python))
        return CellProcess(CELL._replace(path=tmp_path / "out" / "run"), **options)

    return make


def wait_for(path, seconds=60):
    give_up = time.monotonic() + seconds
    while not path.exists() and time.monotonic() < give_up:
        time.sleep(0.02)
    assert path.exists()


@pytest.mark.parametrize(
    ("script", "code", "reason", "lost"),
    [
        ("echo out; echo why >&2; exit 1", 1, "why", False),
        ("exit 2", 2, "it printed nothing", False),
        ("echo score; exit 0", 0, "", False),
        ("echo bad >&2; exit 3", 3, "", False),
        ("echo saved; exit 130", 130, "interrupted; the same command resumes it", False),
        ("kill -9 $$", 1, "killed by SIGKILL", True),
        ("printf 'a\\033[1mb\\n'; exit 1", 1, "a\\x1b[1mb", False),
    ],
)
def test_how_it_ended(start, tmp_path, script, code, reason, lost):
    process = start(script)
    ended = process.wait()
    assert ended == Ended(process.cell, code, reason, lost) == read_ended(process.cell)
    assert (tmp_path / "args").read_text() == "-m experiments.run --steps=5\n"


def test_the_log_has_all_output_and_the_reason_is_of_the_last_process(start, tmp_path):
    process = start("echo one; echo two >&2; exit 1")
    cell = process.cell
    process.wait()
    start("echo three; exit 1").wait()
    text = cell.log.read_text()
    assert {"one", "two", "three"} == set(text.split())
    process = start("exit 1")
    assert read_ended(cell) is None  # it runs
    assert process.wait().reason == "it printed nothing"


def test_an_end_that_cannot_be_written_is_an_end(start, monkeypatch):
    def full(ended):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(cell_process, "write_ended", full)
    assert start("exit 0").wait().code == 0
    process = start("echo why; exit 1")
    assert process.wait().reason == "why"
    process.cell.log.unlink()
    assert process.wait().reason.startswith("its log cannot be read: ")


def test_a_run_that_another_process_trains_says_nothing_of_the_cell(start, tmp_path):
    with folder_lock.locked(tmp_path / "out" / "run"):
        process = start("echo '--name=run: expects another run'; exit 2")
        assert process.wait() == Ended(process.cell, 2, "--name=run: expects another run")
        assert read_ended(process.cell) is None
    start("exit 2").wait()
    assert read_ended(process.cell).code == 2  # the lock is free


@pytest.mark.parametrize(
    ("number", "trap", "code"),
    [
        (signal.SIGTERM, "trap 'exit 130' TERM", 130),
        (signal.SIGTERM, "trap 'exit 0' TERM", 0),
        (signal.SIGUSR2, "trap 'exit 130' USR2", 130),
        (signal.SIGTERM, "", 1),
    ],
    ids=["saved", "ended", "announced", "killed"],
)
def test_a_signal_reaches_it(start, tmp_path, number, trap, code):
    process = start(f"{trap}\ntouch {tmp_path}/began\nwhile :; do sleep 0.05; done")
    wait_for(tmp_path / "began")
    assert process.wait(0) is None
    process.send_signal(number)
    ended = process.wait()
    assert ended.code == code and ended.lost == (not trap)
    process.send_signal(number)  # after its end: no error


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system has no affinity")
def test_it_has_its_own_cores_and_variables(start, tmp_path):
    core = sorted(os.sched_getaffinity(0))[-1]
    start(
        f"{sys.executable} -c 'import os; print(os.sched_getaffinity(0), os.environ[\"WORD\"])' > {tmp_path}/cores",
        cores=(core,),
        variables={"WORD": "yes"},
    ).wait()
    assert (tmp_path / "cores").read_text() == f"{{{core}}} yes\n"


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux kills a process with its starter")
def test_it_dies_with_its_starter(tmp_path):
    python = tmp_path / "python"
    write_python(python, f"echo $$ > {tmp_path}/pid\ntrap '' TERM\nwhile :; do sleep 0.05; done")
    starter = (
        "import sys, pathlib, time; sys.executable = sys.argv[1]\n"
        "from experiments.launchers.cell import Cell\nfrom experiments.launchers.cell_process import CellProcess\n"
        "CellProcess(Cell('ant', 'td3', pathlib.Path(sys.argv[2]), ())); time.sleep(600)"
    )
    command = [sys.executable, "-c", starter, str(python), str(tmp_path / "out" / "run")]
    process = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": str(ROOT)})
    wait_for(tmp_path / "pid")
    process.kill()
    process.wait()
    child = int((tmp_path / "pid").read_text())
    give_up = time.monotonic() + 30
    while _runs(child) and time.monotonic() < give_up:
        time.sleep(0.02)
    assert not _runs(child)


def _runs(pid):
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
