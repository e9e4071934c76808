"""The suite `batches`: the same members in one process and in eight."""

import pytest

from experiments.benchmarks.measure_batches import bench_batches, run_together
from experiments.commandline import flags


def test_the_same_members_are_trained_in_one_process_and_in_eight():
    seen, times = [], iter([0.0, 64.0, 100.0, 228.0])
    found = list(bench_batches("td3_sqt", "cheetah", 128, "mujoco", run=seen.append, clock=lambda: next(times)))
    assert [measurement.rate for measurement in found] == [2.0, 1.0]
    assert found[1].what == "td3_sqt on cheetah, mujoco, 2,000 steps, 8 processes of 16: 128 s"
    assert [len(commands) for commands in seen] == [1, 8]
    for commands in seen:
        options = [flags.parse(["run", *command[3:]]) for command in commands]
        assert [seed for each in options for seed in each.seeds] == list(range(128))
        assert len({each.name for each in options}) == len(options)


def test_members_that_cannot_be_shared_are_rejected():
    with pytest.raises(ValueError, match="multiple of 8 members, not 10"):
        list(bench_batches("td3_sqt", "cheetah", 10, "mujoco", run=lambda commands: None))


def test_a_run_that_fails_is_reported():
    with pytest.raises(RuntimeError, match="^why$"):
        run_together([["true"], ["sh", "-c", "echo why >&2; exit 2"]])
