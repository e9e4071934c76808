"""Runs that are killed end like a run without a break."""

import pytest

from experiments.endurance.kills import kill_and_resume, run_kill_test, train_reference
from experiments.endurance.training_process import TASKS


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """A training without a break (in fact two: the same command twice is bit-identical)."""
    return train_reference("tiny", "td3_sqt", tmp_path_factory.mktemp("reference") / "run")


@pytest.mark.parametrize("number", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_killed_run_ends_like_a_run_without_a_break(tmp_path, reference, number):
    line = kill_and_resume("tiny", "td3_sqt", tmp_path / "run", reference, number)
    assert "killed a" in line and line.endswith("resumed, identical")


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("algo", ["td3_sqt", "sac_sqt_tuple", "td7_sqt"])
def test_more_kills(tmp_path, task, algo):
    reference = train_reference(task, algo, tmp_path / "reference")
    for number in range(100, 108):
        kill_and_resume(task, algo, tmp_path / f"kill_{number}", reference, number)


@pytest.mark.slow
def test_kills_are_spread_over_the_cases_and_failures_counted(tmp_path):
    lines = []
    assert run_kill_test([("tiny", "td3_sqt"), ("tiny", "sac")], 3, 2, tmp_path, lines.append) == 0
    assert sum("resumed, identical" in line for line in lines) == 3
    assert sum("sac: killed" in line for line in lines) == 1
    assert lines[-1] == "3 kills, 3 resumed to the identical end, 0 failed"
