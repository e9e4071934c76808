"""The command line of `experiments.tune`: what goes to which run, and one-line errors."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest
from tuned_runs import GIVEN

from experiments.commandline.arguments import UsageError
from experiments.tuning.tune_flags import check_flags


def test_a_command_line_is_checked_and_parsed():
    options = check_flags(GIVEN, ["--steps=1000", "--nopenalty_inside_gamma", "--hidden=8,8"])
    assert (options.env, options.seeds, options.out, options.baseline) == ("cheetah", (0, 1), Path("runs/tuned"), "td3")
    assert options.flags_of("td3_sqt") == ("--steps=1000", "--nopenalty_inside_gamma", "--hidden=8,8")
    assert options.flags_of("td3") == ("--steps=1000", "--hidden=8,8")  # the penalty's would be refused
    assert [axis.name for axis in options.axes_of("td3")] == ["lr"]
    assert options.settings_of("td3") == {
        "algo": "td3",
        "env": "cheetah",
        "space": "lr=log:0.0001..0.001",
        "batch": 16,
        "seeds": [0, 1],
        "sampler": "tpe",
        "sampler_seed": 0,
        "objective": "score",
        "preset": "paper",
        "settings": {"steps": 1000, "hidden": [8, 8]},
    }


def test_a_baseline_has_no_baseline():
    assert check_flags(GIVEN._replace(algo="td3", space="lr=0..1"), []).baseline is None


@pytest.mark.parametrize(
    ("given", "run_flags", "message"),
    [
        ({"algo": None}, [], "--algo: is required, as in python -m experiments.tune --algo=td3_sqt --env=cheetah "),
        ({"env": ""}, [], "--env: is required, as in "),
        ({"space": None}, [], "--space: is required, as in "),
        ({"algo": "td3_sqd"}, [], "--algo: expects one of td3, "),
        ({"env": "cheetahh"}, [], "--env: expects one of cheetah, "),
        ({"sampler": "cmaes"}, [], "--sampler: expects one of tpe, random, grid, not 'cmaes'"),
        ({"objective": "iqm"}, [], "--objective: expects one of score, final, not 'iqm'"),
        ({"sampler": "grid"}, [], "--space: penalty_coef expects a STEP or values with --sampler=grid, as in "),
        ({"seeds": ["0", "0"]}, [], "--seeds: expects each value once, got 0 2 times"),
        ({"seeds": []}, [], "--seeds=: expects whole numbers like 0,1,2"),
        ({"batch": 9999}, [], "--batch=9999: expects at most 10000 members, trials times seeds"),
        ({}, ["--stepz=5"], "--stepz: unknown flag; did you mean --steps?"),
        ({}, ["--steps=x"], "--steps=x: expects a whole number"),
        ({}, ["steps=5"], "steps=5: expects flags of experiments.run in the form --flag=value, except --algo, "),
        ({}, ["--name=a"], "--name=a: expects flags of experiments.run in the form --flag=value, except --algo, "),
        ({}, ["--paired"], "--paired: expects flags of experiments.run in the form --flag=value, except "),
        ({}, ["--lr=0.1"], "--lr: has no effect where --space tunes it"),
        ({}, ["--tau=0.1,0.2"], "--tau: expects one value: the members of a run are the trials of a batch"),
    ],
)
def test_wrong_flags_are_rejected_in_one_line(given, run_flags, message):
    with pytest.raises(UsageError) as error:
        check_flags(GIVEN._replace(**given), run_flags)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


def test_without_optuna_one_line_names_the_extra(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "optuna" else find(name))
    with pytest.raises(UsageError) as error:
        check_flags(GIVEN, [])
    assert str(error.value) == "--sampler=tpe: expects the package optuna; pip install 'sqt_jax[tune]'"


def test_a_typing_error_is_reported_without_heavy_imports():
    heavy = ("optuna", "mujoco.mjx", "matplotlib", "tensorboardX", "scipy.stats")
    code = f"import sys, experiments.tune; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout == "[]\n"


def test_the_command_names_a_flag_with_a_wrong_value(commands):
    done = commands.run("tune", "--batch=0", "--algo=td3_sqt")
    assert (done.returncode, done.stderr) == (2, "--batch: expects an integer in the range [1, 5000]\n")
