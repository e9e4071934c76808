"""The kill test command."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("flag", "line"), [("--tasks=moon", "--tasks: expects some of tiny, ant"), ("--algos=td4", "--algos: expects some")]
)
def test_unknown_names_are_rejected_in_one_line(flag, line):
    command = [sys.executable, "-m", "experiments.killtest", flag]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1 and done.stderr.startswith(line) and done.stderr.count("\n") == 1
