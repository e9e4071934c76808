"""Training the cells of a grid: which are trained, skipped or resumed, and how signals reach them."""

import json
import os
import signal
import sys
import threading
import time

import pytest

from experiments import run
from experiments.grids.grid import Grid, cells_of, finished
from experiments.grids.train_cells import train_cells, train_in_process
from experiments.running import loop, session

pytestmark = pytest.mark.usefixtures("shared_programs", "tiny_tasks")

TINY = "--seeds=0,1 --steps=60 --warmup_steps=30 --eval_every=30 --eval_episodes=1 --batch_size=8 --hidden=8 --quiet"
GRID = Grid(("td3", "td3_sqt"), ("ant", "walker"))


def train(cell):
    return run.main(["experiments.run", *cell.command])


@pytest.mark.slow
def test_with_config_the_run_itself_decides_whether_it_is_finished(tmp_path, capsys):
    """The file may have been edited since the run started."""
    file, lines = tmp_path / "grid.yaml", []
    rest = [*TINY.replace("--steps=60", f"--config={file}").split(), "--checkpoint_every=20"]
    (cell, *_) = cells_of(GRID, (), (), tmp_path, rest)
    for content, code in (("steps: 60", 0), ("steps: 60", 0), ("steps: 60\nlr: 0.1", 2)):
        file.write_text(content)
        assert train_cells([cell], train, lines.append) == code
    assert "these differ: lr" in capsys.readouterr().err
    assert [line for line in lines if "runs, " in line] == ["1 runs, 0 of them finished"] * 3


@pytest.fixture
def child(tmp_path, monkeypatch):
    """A cell whose process is a shell script instead of a training."""

    def make(script):
        python = tmp_path / "python"
        python.write_text(f"#!/bin/sh\n{script}\n")
        python.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(python))
        return cells_of(GRID, (), (), tmp_path / "out", ())[0]

    return make


@pytest.mark.parametrize(("code", "printed"), [(1, True), (2, True), (134, True), (0, False), (3, False), (130, False)])
def test_the_errors_of_a_run_that_failed_are_printed(child, capfd, code, printed):
    assert train_in_process(child(f"echo out; echo why >&2; exit {code}")) == code
    assert capfd.readouterr() == ("", "why\n" if printed else "")


@pytest.mark.parametrize(
    ("number", "trap"),
    [
        (signal.SIGTERM, "trap 'exit 130' TERM"),
        (signal.SIGTERM, "trap 'exit 0' TERM"),
        (signal.SIGTERM, ""),
        (signal.SIGUSR1, "trap 'exit 130' USR1"),
        (signal.SIGUSR2, ""),
    ],
    ids=["saved", "ended", "killed", "announced", "hung up"],
)
def test_a_signal_is_forwarded(child, tmp_path, number, trap):
    before = signal.getsignal(number)
    began = tmp_path / "began"

    def terminate():
        while not began.exists():
            time.sleep(0.05)
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=terminate, daemon=True)
    thread.start()
    assert train_in_process(child(f"{trap}\ntouch {began}\nwhile :; do sleep 0.05; done")) == 130
    thread.join()
    assert signal.getsignal(number) == before


def test_a_grid_is_trained_once(tmp_path):
    grid = cells_of(GRID, (), (), tmp_path, TINY.split())
    lines, trained = [], []

    def one(cell):
        trained.append((cell.task, cell.algo))
        cell.path.mkdir(parents=True)
        summary = {"status": "done", "diverged": [], "groups": [{"score": {"mean": 5.0, "std": 0.0}}]}
        (cell.path / "summary.json").write_text(json.dumps(summary))
        return 0

    assert train_cells(grid[:3], one, lines.append) == 0
    assert train_cells(grid, one, lines.append) == 0
    assert trained == [("ant", "td3"), ("ant", "td3_sqt"), ("walker", "td3"), ("walker", "td3_sqt")]
    assert lines[0] == "3 runs, 0 of them finished" and lines[4] == "4 runs, 3 of them finished"
    assert lines[1].startswith("1/3 td3 on ant: score 5 +- 0 in ") and lines[3].endswith("; 0:00 left")
    assert all(finished(cell) for cell in grid)


def test_an_interrupted_cell_is_resumed(tmp_path, monkeypatch):
    (cell, *_) = cells_of(GRID, (), (), tmp_path, [*TINY.split(), "--checkpoint_every=20"])
    lines = []

    def stopped(*arguments, stop, **options):
        asked = iter([False, False])  # a chunk or two
        return loop.train_loop(*arguments, stop=lambda: next(asked, True), **options)

    with monkeypatch.context() as patch:
        patch.setattr(session, "train_loop", stopped)
        assert train_cells([cell], train, lines.append) == 130
    assert "the same command resumes it" in lines[-1] and finished(cell) is None
    assert train_cells([cell], train, lines.append) == 0
    assert json.loads((cell.path / "config.json").read_text())["resumed"]


def test_a_cell_that_cannot_be_trained_ends_the_sweep(tmp_path):
    lines = []
    grid = cells_of(GRID, (), (), tmp_path, ["--steps=-1"])
    assert train_cells(grid, train, lines.append) == 2
    assert len(lines) == 2 and not any(tmp_path.iterdir())
    assert lines[-1] == "td3 on ant: ended with exit code 2"  # no hint: the same command would fail again


def test_a_diverged_member_does_not_end_the_sweep(tmp_path):
    grid = cells_of(Grid(("td3_sqt",), ("ant",)), (), (), tmp_path, [*TINY.split(), "--penalty_coef=1e38"])
    lines = []
    assert train_cells(grid, train, lines.append) == 3
    assert lines[-1].startswith("1/1 td3_sqt on ant: score") and "(2 diverged)" in lines[-1]
    assert train_cells(grid, lambda cell: pytest.fail("it has ended"), lines.append) == 0
