"""Training the cells of a grid: which are trained, skipped, retried or cancelled, and what is said in the end."""

import json
from pathlib import Path

import pytest

from experiments import run
from experiments.commandline.arguments import BAD_USAGE, DIVERGED, DONE, FAILED, INTERRUPTED
from experiments.grids.finished import finished
from experiments.grids.grid import Grid, cells_of
from experiments.grids.train_cells import repeat_command, submit_and_leave, train_cells
from experiments.launchers.cell import Ended
from experiments.running import loop, session

pytestmark = pytest.mark.usefixtures("shared_programs", "tiny_tasks")

TINY = "--seeds=0,1 --steps=60 --warmup_steps=30 --eval_every=30 --eval_episodes=1 --batch_size=8 --hidden=8 --quiet"
GRID = Grid(("td3", "td3_sqt"), ("ant", "walker"))


class OneByOne:
    """A launcher that calls a function for each cell: it returns an exit code or an `Ended`."""

    def __init__(self, train, cancelled=lambda: None):
        self.train, self.waiting, self.cancels, self.left = train, [], 0, False

    def submit(self, cells):
        self.waiting += cells

    def ended(self):
        if not self.waiting:
            return []
        cell = self.waiting.pop(0)
        code = Ended(cell, INTERRUPTED, "not started") if self.cancels else self.train(cell)
        return [code if isinstance(code, Ended) else Ended(cell, code, "" if code in (DONE, DIVERGED) else "why")]

    def cancel(self):
        self.cancels += 1

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.left = True


def in_this_process(cell):
    return run.main(["experiments.run", *cell.command])


def write_summary(cell):
    cell.path.mkdir(parents=True)
    summary = {"status": "done", "diverged": [], "groups": [{"score": {"mean": 5.0, "std": 0.0}}]}
    (cell.path / "summary.json").write_text(json.dumps(summary))
    return DONE


@pytest.mark.slow
def test_with_config_the_run_itself_decides_whether_it_is_finished(tmp_path, capsys):
    """The file may have been edited since the run started."""
    file, lines = tmp_path / "grid.yaml", []
    rest = [*TINY.replace("--steps=60", f"--config={file}").split(), "--checkpoint_every=20"]
    (cell, *_) = cells_of(GRID, (), (), tmp_path, rest)
    for content, code in (("steps: 60", 0), ("steps: 60", 0), ("steps: 60\nlr: 0.1", 2)):
        file.write_text(content)
        assert train_cells([cell], OneByOne(in_this_process), lines.append) == code
    assert "these differ: lr" in capsys.readouterr().err
    assert [line for line in lines if "runs, " in line] == ["1 runs, 0 of them finished"] * 3


def test_a_grid_is_trained_once(tmp_path):
    grid = cells_of(GRID, (), (), tmp_path, TINY.split())
    lines, trained = [], []

    def one(cell):
        trained.append((cell.task, cell.algo))
        return write_summary(cell)

    assert train_cells(grid[:3], OneByOne(one), lines.append) == DONE
    launcher = OneByOne(one)
    assert train_cells(grid, launcher, lines.append) == DONE and launcher.left
    assert trained == [("ant", "td3"), ("ant", "td3_sqt"), ("walker", "td3"), ("walker", "td3_sqt")]
    assert lines[0] == "3 runs, 0 of them finished" and lines[4] == "4 runs, 3 of them finished"
    assert lines[1].startswith("1/3 td3 on ant: score 5 +- 0; ") and lines[3].endswith("; 0:00 left")
    assert all(finished(cell) for cell in grid)


def test_an_interrupted_cell_is_resumed(tmp_path, monkeypatch):
    (cell,) = cells_of(Grid(("td3_sqt",), ("ant",)), (), (), tmp_path, [*TINY.split(), "--checkpoint_every=20"])
    lines = []

    def stopped(*arguments, stop, **options):
        asked = iter([False, False])  # a chunk or two
        return loop.train_loop(*arguments, stop=lambda: next(asked, True), **options)

    with monkeypatch.context() as patch:
        patch.setattr(session, "train_loop", stopped)
        assert train_cells([cell], OneByOne(in_this_process), lines.append) == INTERRUPTED
    assert finished(cell) is None
    assert train_cells([cell], OneByOne(in_this_process), lines.append) == DONE
    assert json.loads((cell.path / "config.json").read_text())["resumed"]


def test_a_cell_that_fails_does_not_stop_the_others_and_is_listed(tmp_path):
    cells, lines = cells_of(GRID, (), (), tmp_path, ["--steps=10"]), []

    def one(cell):
        return write_summary(cell) if cell.algo == "td3" else Ended(cell, BAD_USAGE, "--lr: expects a number")

    assert train_cells(cells, OneByOne(one), lines.append) == BAD_USAGE
    assert [bool(finished(cell)) for cell in cells] == [True, False, True, False]
    assert lines[5] == "2 of 4 runs did not finish:"
    assert lines[6:9] == [
        "  td3_sqt on ant: --lr: expects a number",
        f"    log: {cells[1].log}",
        f"    repeat: python -m experiments.run --algo=td3_sqt --env=ant --out={tmp_path} --name=steps=10 --resume "
        "--steps=10",
    ]


def test_the_command_that_repeats_a_cell_is_quoted_for_a_shell():
    (cell, *_) = cells_of(GRID, (), (), Path("my runs"), [])
    assert "'--out=my runs'" in repeat_command(cell)


@pytest.mark.parametrize(
    ("codes", "worst"),
    [
        ((DONE, DIVERGED), DIVERGED),
        ((DIVERGED, BAD_USAGE), BAD_USAGE),
        ((BAD_USAGE, FAILED), FAILED),
        ((FAILED, INTERRUPTED), INTERRUPTED),
        ((DONE, 134), FAILED),
        ((), DONE),
    ],
)
def test_the_exit_code_is_the_worst(tmp_path, codes, worst):
    cells = cells_of(GRID, (), (), tmp_path, ())[: len(codes)]
    given = iter(codes)
    assert train_cells(cells, OneByOne(lambda cell: next(given)), lambda line: None) == worst


@pytest.mark.parametrize(("losses", "code"), [(0, DONE), (2, DONE), (3, FAILED)])
def test_a_lost_cell_is_started_again(tmp_path, losses, code):
    cells, lines, starts = cells_of(GRID, (), (), tmp_path, ())[:2], [], {}

    def one(cell):
        starts[cell] = starts.get(cell, 0) + 1
        lost = cell == cells[0] and starts[cell] <= losses
        return Ended(cell, FAILED, "killed by SIGKILL", lost=True) if lost else write_summary(cell)

    assert train_cells(cells, OneByOne(one), lines.append, retries=2) == code
    assert starts == {cells[0]: min(losses, 2) + 1, cells[1]: 1}
    again = [line for line in lines if "started again" in line]
    assert again == [f"td3 on ant: killed by SIGKILL; started again ({n} of 2)" for n in range(1, min(losses, 2) + 1)]


@pytest.mark.parametrize("fail_fast", [False, True])
def test_fail_fast_cancels_the_others(tmp_path, fail_fast):
    cells, trained = cells_of(GRID, (), (), tmp_path, ()), []

    def one(cell):
        trained.append(cell)
        return FAILED

    launcher = OneByOne(one)
    code = train_cells(cells, launcher, lambda line: None, fail_fast=fail_fast)
    assert (len(trained), launcher.cancels, code) == ((1, 1, FAILED) if fail_fast else (4, 0, FAILED))


def test_signals_cancel_once_each_and_a_lost_cell_is_then_interrupted(tmp_path):
    cells, signals, lines = cells_of(GRID, (), (), tmp_path, ()), [], []

    def one(cell):
        signals.extend((15, 15, 15))
        return Ended(cell, FAILED, "killed by SIGTERM", lost=True)  # before it could save

    launcher = OneByOne(one)
    code = train_cells(cells, launcher, lines.append, retries=2, signals=lambda: len(signals))
    assert code == INTERRUPTED and launcher.cancels == 2
    assert lines[1].startswith("1/4 td3 on ant: interrupted; the same command resumes it; ")
    assert [line.split("; ")[0] for line in lines[2:5]] == [
        "2/4 td3_sqt on ant: not started",
        "3/4 td3 on walker: not started",
        "4/4 td3_sqt on walker: not started",
    ]


def test_a_diverged_member_is_a_result(tmp_path):
    grid = cells_of(Grid(("td3_sqt",), ("ant",)), (), (), tmp_path, [*TINY.split(), "--penalty_coef=1e38"])
    lines = []
    assert train_cells(grid, OneByOne(in_this_process), lines.append) == DIVERGED
    assert lines[-1].startswith("1/1 td3_sqt on ant: score") and "(2 diverged)" in lines[-1]
    assert train_cells(grid, OneByOne(lambda cell: pytest.fail("it has ended")), lines.append) == DONE


def test_what_is_submitted_can_be_left(tmp_path):
    grid, lines = cells_of(GRID, (), (), tmp_path, TINY.split()), []
    write_summary(grid[0])

    class Left(OneByOne):
        already_queued = {grid[1]: "its job"}

    launcher = Left(lambda cell: pytest.fail("nobody waits"))
    assert submit_and_leave(grid, launcher, lines.append) == 0 and launcher.waiting == grid[1:]
    assert lines[0] == "4 runs, 1 of them finished, 1 already submitted"
    assert lines[1] == "2 submitted; the same command with --status shows them"
