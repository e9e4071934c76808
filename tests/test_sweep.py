"""The sweep command."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("", "--grid: expects one of table2, table3, table4, all, alpha\n"),
        ("--preset=table2", "--grid: expects one of table2, "),
        ("--grid=table2 --algos=td4", "--algos: expects one of td3, "),
        ("--grid=table2 --tasks=antt", "--tasks: expects one of cheetah, "),
        (
            "--grid=table2 --name=x",
            "--name=x: expects flags of experiments.run in the form --flag=value, except --algo",
        ),
        ("--grid=table2 --tasks=ant --stepz=4", "--stepz: unknown flag; did you mean --steps?"),
    ],
)
def test_the_command_rejects_in_one_line(tmp_path, arguments, line):
    command = [sys.executable, "-m", "experiments.sweep", f"--out={tmp_path / 'out'}", *arguments.split()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.startswith(line) and done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists() or not any(path.is_dir() for path in (tmp_path / "out").glob("*/*/*"))


def test_help_says_that_other_flags_go_to_every_run():
    command = [sys.executable, "-m", "experiments.sweep", "--help"]
    out = subprocess.run(command, capture_output=True, text=True, timeout=120).stdout
    assert "--grid" in out and "to every run, for example --steps=1000000" in " ".join(out.split())
