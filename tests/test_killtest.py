"""The kill test command."""

import pytest


@pytest.mark.parametrize(
    ("flag", "line"), [("--tasks=moon", "--tasks: expects some of tiny, ant"), ("--algos=td4", "--algos: expects some")]
)
def test_unknown_names_are_rejected_in_one_line(commands, flag, line):
    done = commands.run("killtest", flag)
    assert done.returncode == 1 and done.stderr.startswith(line) and done.stderr.count("\n") == 1
