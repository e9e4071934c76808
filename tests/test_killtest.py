"""Runs that are killed, for real."""

import numpy as np
import pytest

from experiments import killtest


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A training without a break (two, in fact: the same command twice is bit-identical)."""
    return killtest.reference("tiny", "td3_sqt", tmp_path_factory.mktemp("whole") / "run")


@pytest.mark.parametrize("number", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_run_that_is_killed_ends_as_if_it_had_not_been(tmp_path, whole, number):
    line = killtest.kill_and_resume("tiny", "td3_sqt", tmp_path / "run", whole, number)
    assert "killed a" in line and line.endswith("resumed, identical")


@pytest.mark.slow
@pytest.mark.parametrize("task", killtest.TASKS)
@pytest.mark.parametrize("algo", ["td3_sqt", "sac_sqt_tuple", "td7_sqt"])
def test_more_kills(tmp_path, task, algo):
    whole = killtest.reference(task, algo, tmp_path / "whole")
    for number in range(100, 108):
        killtest.kill_and_resume(task, algo, tmp_path / f"kill_{number}", whole, number)


def test_the_smallest_difference_is_seen():
    one = {"a": np.zeros(3, np.float32), "metrics": [{"q_mean": "1.5"}]}
    assert killtest.differences(one, one) == []
    nearly = one | {"a": np.array([0, 0, np.nextafter(np.float32(0), np.float32(1))], np.float32)}
    assert killtest.differences(one, nearly) == ["a"]
    assert killtest.differences(one, one | {"a": -one["a"]}) == ["a"]  # -0.0
    assert killtest.differences(one, one | {"metrics": []}) == ["metrics"]
    assert killtest.differences(one, {"a": one["a"]}) == ["metrics"]
