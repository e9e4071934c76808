"""Two trainings and a resumed one, compared array by array."""

import json

import pytest

from experiments.benchmarks import exact_resume
from experiments.benchmarks.exact_resume import RESUMED, WHOLE
from experiments.benchmarks.measurements import EQUAL


def test_the_share_of_equal_arrays_is_reported():
    commands = []
    sums = iter([{"a": "1", "b": "2"}, {"a": "1", "b": "2"}, {"a": "1", "b": "3"}])

    def run(command):
        commands.append(command[3:])
        return json.dumps(next(sums))

    again, resumed = exact_resume.compare("td3", "ant", "mjx", 5, label=", a label", steps=10, run=run)
    assert again.what == "td3 on ant, mjx, 10 steps, a label, the same again: bit for bit equal"
    assert resumed.what == "td3 on ant, mjx, 10 steps, a label, resumed: differs in b"
    assert again.figure == ("100", EQUAL) and resumed.figure == ("50", EQUAL)
    assert [command[:-2] for command in commands] == [["td3", "ant", "mjx", "5", "10"]] * 3
    first, second, third = (command[-2:] for command in commands)
    assert [first[1], second[1], third[1]] == [WHOLE, WHOLE, RESUMED]
    assert third[0] == first[0] != second[0]  # resumes the first one's checkpoint


@pytest.mark.slow
def test_training_repeats_and_resumes_here():
    found = list(exact_resume.compare("td3_sqt", "cheetah", "mujoco", 1, steps=20))
    assert [row.rate for row in found] == [100.0, 100.0]
