"""The state of a grid's runs from their files."""

import json
import os

import pytest
from made_runs import write_run

from experiments.grids.status import Progress, state_of, status_lines
from experiments.launchers.cell import Cell, Ended, write_ended
from experiments.running import folder_lock


@pytest.fixture
def cell(tmp_path):
    """A cell without any file."""
    return Cell(task="ant", algo="td3", path=tmp_path / "ant" / "td3" / "run", command=())


def begin(cell, **settings):
    """Gives the cell a run without a summary."""
    write_run(cell.path.parent.parent.parent, "td3", "ant", name="run", **settings)


def test_a_cell_without_files_waits(cell):
    assert state_of(cell) == ("waiting", "")


def test_a_run_that_has_ended_is_done(cell):
    cell.path.mkdir(parents=True)
    summary = {"status": "diverged", "diverged": [{}], "groups": [{"score": {"mean": 1234.5, "std": 6.0}}]}
    (cell.path / "summary.json").write_text(json.dumps(summary))
    assert state_of(cell) == ("done", "score 1,234 +- 6 (1 diverged)")


def test_a_cell_that_failed_says_why(cell):
    cell.path.parent.mkdir(parents=True)
    write_ended(Ended(cell, 2, "--lr: expects a number"))
    assert state_of(cell) == ("failed", f"--lr: expects a number; log: {cell.log}")


@pytest.mark.parametrize(
    ("ended", "text"),
    [
        (None, ""),
        (Ended(None, 1, "killed by SIGKILL", lost=True), " (killed by SIGKILL)"),
        (
            Ended(None, 130, "interrupted; the same command resumes it"),
            " (interrupted; the same command resumes it)",
        ),
    ],
)
def test_a_run_that_was_interrupted_says_how_far_it_is(cell, ended, text):
    begin(cell, steps=200)
    if ended:
        write_ended(ended._replace(cell=cell))
    # 10 s for 100 steps, by the table's last row
    assert state_of(cell) == ("interrupted", f"step 100 of 200, 0:10 left{text}")


def test_a_run_that_is_locked_is_running(cell):
    begin(cell, steps=200)
    with folder_lock.locked(cell.path):
        word, text = state_of(cell)
        assert (
            word == "running" and text.startswith("step 100 of 200, 0:10 left (") and f"process {os.getpid()}" in text
        )
        write_ended(Ended(cell, 1, "killed by SIGKILL", lost=True))  # the lock's record still looks alive
        os.utime(cell.path / "lock", (0, cell.ended_file.stat().st_mtime - 1))
        assert state_of(cell).word == "interrupted"
        cell.ended_file.unlink()
    assert state_of(cell).word == "interrupted"


def test_a_run_whose_folder_was_removed_waits(cell):
    cell.path.parent.mkdir(parents=True)
    write_ended(Ended(cell, 0, ""))
    assert state_of(cell) == ("waiting", "")


def test_a_batch_system_knows_more_than_the_files(cell):
    waiting, running, failed = (
        ("waiting", "job 1_0 (Priority)"),
        ("running", "job 1_0"),
        ("failed", "--out: no"),
    )
    assert state_of(cell, waiting) == waiting and state_of(cell, failed) == failed
    assert state_of(cell, running) == ("running", "before its first evaluation; job 1_0")
    begin(cell, steps=200)
    assert state_of(cell, waiting) == ("waiting", "step 100 of 200, 0:10 left; job 1_0 (Priority)")
    write_ended(Ended(cell, 1, "why"))  # written by the run itself, later than what ended the job
    assert state_of(cell, failed) == ("failed", f"why; log: {cell.log}")
    assert status_lines([cell], {cell: waiting})[-1] == "1 runs: 1 waiting"


def test_time_left_is_not_known_before_a_step():
    assert Progress(0, 100, 3.0).seconds_left is None
    assert Progress(25, 100, 3.0).seconds_left == 9.0


def test_the_table_has_a_line_per_cell_and_counts(cell, tmp_path):
    other = Cell(task="ant", algo="td3_sqt", path=tmp_path / "b", command=())
    write_ended(Ended(other, 1, "why"))
    assert status_lines([cell, other]) == [
        "td3 on ant      waiting",
        f"td3_sqt on ant  failed       why; log: {other.log}",
        "2 runs: 1 waiting, 1 failed",
    ]
