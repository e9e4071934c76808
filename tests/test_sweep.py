"""The grids of runs: what is trained, what is left alone, what is gone on with."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import probe_envs
import pytest

from experiments import run
from experiments.running import loop
from experiments.sweep import PRESETS, Preset, cells, finished, name_of, run_in_a_process, sweep
from sqt_jax.algorithms import ALGORITHMS

pytestmark = pytest.mark.usefixtures("shared_programs")

TINY = "--seeds=0,1 --steps=60 --warmup_steps=30 --eval_every=30 --eval_episodes=1 --batch_size=8 --hidden=8 --quiet"
GRID = Preset(("td3", "td3_sqt"), ("ant", "walker"))


def train(cell):
    return run.main(["experiments.run", *cell.command], env=probe_envs.constant_reward(5))


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_name_algorithms_and_tasks_that_exist(preset):
    grid = cells(PRESETS[preset], (), (), Path("runs"), ())
    assert {cell.algo for cell in grid} <= ALGORITHMS.keys() and len(grid) == len(set(grid)) > 0
    assert all(run.flags.parse(["run", *cell.command]) for cell in grid)


def test_tables_2_to_4_are_the_papers_nine_on_its_four_tasks():
    def of(name):
        return {(cell.algo, cell.path) for cell in cells(PRESETS[name], (), (), Path("runs"), ("--steps=1000",))}

    assert of("table2") == of("table3") and of("table2") | of("table4") == of("all")
    assert len({algo for algo, _ in of("all")}) == 9 and len(of("all")) == 36


def test_an_ordinary_cell_is_called_by_its_flags():
    assert name_of(["--steps=10", "--hidden=8,8", "--out=a/b"]) == "hidden=8,8_out=a-b_steps=10"
    assert name_of([]) == "default"


def test_names_that_are_cut_tell_cells_apart():
    common = [f"--seeds={','.join(map(str, range(100)))}"]
    one, other = (name_of([*common, f"--steps={steps}"]) for steps in (100, 200))
    assert one != other == name_of([*common, "--steps=200"]) and len(one) == len(other) == 200


def test_with_a_file_of_settings_the_run_itself_says_whether_it_is_finished(tmp_path, capsys):
    """The file may have been edited since."""
    file, lines = tmp_path / "grid.yaml", []
    rest = [*TINY.replace("--steps=60", f"--config={file}").split(), "--checkpoint_every=20"]
    (cell, *_) = cells(GRID, (), (), tmp_path, rest)
    for content, code in (("steps: 60", 0), ("steps: 60", 0), ("steps: 60\nlr: 0.1", 2)):
        file.write_text(content)
        assert sweep([cell], train, lines.append) == code
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
        return cells(GRID, (), (), tmp_path / "out", ())[0]

    return make


@pytest.mark.parametrize(("code", "told"), [(1, True), (2, True), (134, True), (0, False), (3, False), (130, False)])
def test_the_last_words_of_a_run_that_failed_are_told(child, capfd, code, told):
    assert run_in_a_process(child(f"echo out; echo why >&2; exit {code}")) == code
    assert capfd.readouterr() == ("", "why\n" if told else "")


@pytest.mark.parametrize("trap", ["trap 'exit 130' TERM", "trap 'exit 0' TERM", ""], ids=["saved", "ended", "killed"])
def test_a_sigterm_is_passed_on(child, tmp_path, trap):
    before = signal.getsignal(signal.SIGTERM)
    began = tmp_path / "began"

    def terminate():
        while not began.exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=terminate, daemon=True)
    thread.start()
    assert run_in_a_process(child(f"{trap}\ntouch {began}\nwhile :; do sleep 0.05; done")) == 130
    thread.join()
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_grid_is_trained_once(tmp_path):
    grid = cells(GRID, (), (), tmp_path, TINY.split())
    lines, trained = [], []

    def one(cell):
        trained.append((cell.task, cell.algo))
        cell.path.mkdir(parents=True)
        summary = {"status": "done", "diverged": [], "groups": [{"score": {"mean": 5.0, "std": 0.0}}]}
        (cell.path / "summary.json").write_text(json.dumps(summary))
        return 0

    assert sweep(grid[:3], one, lines.append) == 0
    assert sweep(grid, one, lines.append) == 0
    assert trained == [("ant", "td3"), ("ant", "td3_sqt"), ("walker", "td3"), ("walker", "td3_sqt")]
    assert lines[0] == "3 runs, 0 of them finished" and lines[4] == "4 runs, 3 of them finished"
    assert lines[1].startswith("1/3 td3 on ant: score 5 +- 0 in ") and lines[3].endswith("; 0:00 left")
    assert all(finished(cell) for cell in grid)


def test_what_was_interrupted_is_gone_on_with(tmp_path, monkeypatch):
    (cell, *_) = cells(GRID, (), (), tmp_path, [*TINY.split(), "--checkpoint_every=20"])
    lines = []

    def stopped(*arguments, stop, **options):
        asked = iter([False, False])  # a chunk or two
        return loop.train_loop(*arguments, stop=lambda: next(asked, True), **options)

    with monkeypatch.context() as patch:
        patch.setattr(run, "train_loop", stopped)
        assert sweep([cell], train, lines.append) == 130
    assert "goes on from there" in lines[-1] and finished(cell) is None
    assert sweep([cell], train, lines.append) == 0
    assert json.loads((cell.path / "config.json").read_text())["resumed"]


def test_a_cell_that_cannot_be_trained_ends_the_sweep(tmp_path):
    lines = []
    grid = cells(GRID, (), (), tmp_path, ["--steps=-1"])
    assert sweep(grid, train, lines.append) == 2
    assert len(lines) == 2 and not any(tmp_path.iterdir())
    assert lines[-1] == "td3 on ant: ended with exit code 2"  # the same command would end so again


def test_a_diverged_member_does_not(tmp_path):
    grid = cells(Preset(("td3_sqt",), ("ant",)), (), (), tmp_path, [*TINY.split(), "--penalty_coef=1e38"])
    lines = []
    assert sweep(grid, train, lines.append) == 3
    assert lines[-1].startswith("1/1 td3_sqt on ant: score") and "(2 diverged)" in lines[-1]
    assert sweep(grid, lambda cell: pytest.fail("it has ended"), lines.append) == 0


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("", "--preset: expects one of table2, table3, table4, all, alpha\n"),
        ("--preset=table2 --algos=td4", "--algos: expected one of td3, "),
        ("--preset=table2 --tasks=antt", "--tasks: expected one of cheetah, "),
        (
            "--preset=table2 --name=x",
            "--name=x: expects flags of experiments.run in the form --flag=value, but for --algo",
        ),
        ("--preset=table2 --tasks=ant --stepz=4", "--stepz: unknown flag; did you mean --steps?"),
    ],
)
def test_the_command_refuses_in_one_line(tmp_path, arguments, line):
    command = [sys.executable, "-m", "experiments.sweep", f"--out={tmp_path / 'out'}", *arguments.split()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.startswith(line) and done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists() or not any(path.is_dir() for path in (tmp_path / "out").glob("*/*/*"))
