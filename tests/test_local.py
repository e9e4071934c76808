"""The local launcher: shares of cores and GPUs, side by side, cancelling."""

import json
import os
import signal

import psutil
import pytest
from started_sweeps import Run, rows, start_sweep, wait_for

from experiments.commandline.arguments import FAILED, INTERRUPTED, UsageError
from experiments.launchers.cell import Cell, Ended
from experiments.launchers.local import LocalLauncher, Share, shares, visible_gpus

CELLS = [Cell(task=str(index), algo="td3", path=None, command=()) for index in range(4)]


class Process:
    """Ends when told."""

    started = []

    def __init__(self, cell, cores, variables):
        self.cell, self.cores, self.code, self.signals = cell, cores, None, []
        Process.started.append(self)

    def wait(self, seconds=None):
        if self.code is None and seconds is None:
            self.code = -9
        return None if self.code is None else Ended(self.cell, self.code, "")

    def send_signal(self, number):
        self.signals.append(number)


@pytest.fixture(autouse=True)
def _none_started():
    Process.started = []


def test_one_worker_has_everything():
    assert shares(1, [0, 1, 2], []) == [Share()] == shares(1, [0], ["0", "1"])
    assert Share().variables == {}


def test_workers_share_cores_without_overlap():
    assert shares(2, [4, 5, 6, 7, 8], []) == [Share((4, 5, 6)), Share((7, 8))]


def test_workers_share_gpus_and_cores():
    parts = shares(2, [0, 1, 2, 3], ["0", "1", "2", "3"])
    assert parts == [Share((0, 1), ("0", "1")), Share((2, 3), ("2", "3"))]
    assert parts[1].variables == {"CUDA_VISIBLE_DEVICES": "2,3"}


@pytest.mark.parametrize(
    ("cores", "gpus", "what"), [([0, 1], [], "2, the number of cores"), ([0, 1, 2, 3], ["0"], "1, the number of GPUs")]
)
def test_more_workers_than_parts_are_refused(cores, gpus, what):
    with pytest.raises(UsageError, match=f"^--workers=3: expects at most {what} here$"):
        shares(3, cores, gpus)


@pytest.mark.parametrize(
    ("variables", "gpus"),
    [
        ({"CUDA_VISIBLE_DEVICES": "2,GPU-1f"}, ["2", "GPU-1f"]),
        ({"CUDA_VISIBLE_DEVICES": ""}, []),
        ({"CUDA_VISIBLE_DEVICES": "0,1", "JAX_PLATFORMS": "cpu"}, []),
        ({"CUDA_VISIBLE_DEVICES": "0", "JAX_PLATFORMS": "cuda,cpu"}, ["0"]),
    ],
)
def test_gpus_are_those_that_jax_would_use(variables, gpus):
    assert visible_gpus(variables) == gpus


def test_gpus_are_counted_by_nvidia_smi(tmp_path, monkeypatch):
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\necho 'GPU 0: A (UUID: x)'\necho 'GPU 1: A (UUID: y)'\necho '  MIG 1g'\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    assert visible_gpus({}) == ["0", "1"]


def test_cells_run_side_by_side_each_on_a_free_share():
    with LocalLauncher([Share((0,)), Share((1,))], Process) as launcher:
        launcher.submit(CELLS)
        assert [(p.cell, p.cores) for p in Process.started] == [(CELLS[0], (0,)), (CELLS[1], (1,))]
        Process.started[1].code = 0
        assert launcher.ended() == [Ended(CELLS[1], 0, "")]
        assert [(p.cell, p.cores) for p in Process.started[2:]] == [(CELLS[2], (1,))]
        Process.started[0].code = Process.started[2].code = 0
        assert [ended.cell for ended in launcher.ended()] == [CELLS[0], CELLS[2]]
        assert Process.started[3].cores == (0,)
        Process.started[3].code = 1
        assert [ended.code for ended in launcher.ended()] == [1]
        assert launcher.ended() == []
    assert not any(process.signals for process in Process.started)


def test_a_cell_that_cannot_be_started_fails_and_the_others_go_on():
    def start(cell, cores, variables):
        if cell == CELLS[0]:
            raise IsADirectoryError(21, "Is a directory", "a.log.txt")
        return Process(cell, cores, variables)

    with LocalLauncher([Share((0,))], start) as launcher:
        launcher.submit(CELLS[:2])
        failed = Ended(CELLS[0], FAILED, "cannot be started: [Errno 21] Is a directory: 'a.log.txt'")
        (process,) = Process.started
        process.code = 0
        assert launcher.ended() == [failed] and launcher.ended() == [Ended(CELLS[1], 0, "")]
        launcher.submit(CELLS[:1])
        assert launcher.ended() == [failed]


def test_cancel_asks_the_running_ones_and_drops_the_waiting_ones():
    with LocalLauncher([Share()], Process) as launcher:
        launcher.submit(CELLS[:3])
        launcher.cancel()
        assert launcher.ended() == [Ended(cell, INTERRUPTED, "not started") for cell in CELLS[1:3]]
        (process,) = Process.started
        assert process.signals == [signal.SIGTERM]
        launcher.cancel()
        assert process.signals == [signal.SIGTERM, signal.SIGKILL]
        process.code = INTERRUPTED
        assert [ended.cell for ended in launcher.ended()] == CELLS[:1]


def test_an_error_leaves_no_process():
    with pytest.raises(KeyError), LocalLauncher([Share()], Process) as launcher:
        launcher.submit(CELLS)
        raise KeyError
    (process,) = Process.started
    assert process.signals == [signal.SIGKILL] and process.code == -9


@pytest.mark.slow
@pytest.mark.skipif(len(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else ()) < 2, reason="one core")
def test_two_workers_one_of_whose_runs_is_killed_have_the_rows_of_one_after_another(tmp_path):
    grid = ["--algos=td3,td3_sqt"]
    plain = start_sweep(tmp_path / "plain", *grid, core=sorted(os.sched_getaffinity(0))[0])
    plain.communicate()
    sweep = start_sweep(tmp_path / "out", *grid, "--workers=2")
    parent = psutil.Process(sweep.pid)

    def runs():
        return [Run(parent, child) for child in parent.children() if "experiments.run" in child.cmdline()]

    run = wait_for(lambda: next((run for run in runs() if run.is_half_done()), None))
    assert len({tuple(run.process.cpu_affinity()) for run in runs()}) == 2
    run.process.kill()
    text, errors = sweep.communicate(timeout=240)
    assert (plain.returncode, sweep.returncode, errors) == (0, 0, ""), text + errors
    assert ": killed by SIGKILL; started again (1 of 2)\n" in text
    assert json.loads((run.path / "config.json").read_text())["resumed"]
    assert rows(tmp_path / "out") == rows(tmp_path / "plain") and len(rows(tmp_path / "out")) == 4
