"""Cells are checked before any of them starts."""

from pathlib import Path

import pytest

from experiments.commandline.arguments import UsageError
from experiments.grids.grid import make_cells


def refusal(grid, algos, tasks, *run_flags):
    with pytest.raises(UsageError) as error:
        make_cells(grid, algos, tasks, Path("runs"), run_flags)
    return str(error.value)


@pytest.mark.parametrize(
    ("algos", "tasks", "line"),
    [
        (["td3", "sac", "td3"], ["ant"], "--algos: expects each one once, not td3 and td3"),
        (["td3"], ["cheetah", "half_cheetah"], "--tasks: expects each one once, not cheetah and half_cheetah"),
        (
            ["td3"],
            ["scaled_pendulum:make", "scaled_pendulum:make_again"],
            "--tasks: expects environments of different names, not scaled_pendulum:make and "
            "scaled_pendulum:make_again, which are both pendulum",
        ),
    ],
)
def test_an_algorithm_or_task_that_comes_twice_is_rejected(monkeypatch, algos, tasks, line):
    import scaled_pendulum

    monkeypatch.setattr(scaled_pendulum, "make_again", scaled_pendulum.make, raising=False)
    assert refusal(None, algos, tasks) == line
    assert refusal("table2", algos, tasks) == line


@pytest.mark.parametrize(
    ("grid", "words"),
    [
        ("penalty_coef=0.1,0.10", "--penalty_coef=0.1 and --penalty_coef=0.10"),
        ("steps=100000,1e5;lr=1e-4", "--steps=100000 and --steps=1e5"),
        ("wandb=a,b", "--wandb=a and --wandb=b"),
        ("layer_norm=true,1", "--layer_norm=true and --layer_norm=1"),
    ],
)
def test_values_that_make_the_same_run_are_rejected(grid, words):
    line = f"--grid: expects different runs, not {words}, which are the same one"
    assert refusal(grid, ["td3_sqt"], ["ant"]) == line


@pytest.mark.parametrize(
    ("run_flags", "line"),
    [
        (["--penalty_coef=0.1"], "--penalty_coef: has no effect with td3"),
        (["--penalty_coef=0.1,0.2"], "--penalty_coef: has no effect with td3"),
        (
            ["--steps=100"],
            "--warmup_steps: expects fewer than the run's steps (100), not 25000: nothing would be learned",
        ),
        (["--physics=spring"], "--physics: expects one of "),
    ],
)
def test_settings_that_a_run_would_refuse_are_rejected(run_flags, line):
    assert refusal(None, ["td3_sqt", "td3"], ["ant"], *run_flags).startswith(line)


def test_settings_of_an_own_environment_are_checked_with_it():
    task = "scaled_pendulum:make"
    assert len(make_cells(None, ["td3", "td3_sqt"], [task], Path("runs"), ["--env_args=scale=2.0"])) == 2
    line = "--physics: has no effect with an environment handed in"
    assert refusal(None, ["td3"], [task], "--physics=mujoco") == line
    assert refusal(None, ["td3"], [task], "--env_args=weight=2").startswith(f"--tasks: {task}: ")
