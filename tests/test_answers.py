"""What commands that start runs print."""

import errno

import pytest

from experiments.commandline.answers import refused_in_one_line, say
from experiments.commandline.arguments import UsageError


def test_lines_are_printable(capsys):
    say("one", "two\x1b[1m")
    assert capsys.readouterr().out == "one\ntwo\\x1b[1m\n"


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (UsageError("--lr: expects\na number"), "--lr: expects\\na number\n"),
        (
            OSError(errno.ENOSPC, "No space left on device"),
            "--out=runs: expects a folder that can be written: [Errno 28] No space left on device\n",
        ),
    ],
)
def test_a_refusal_is_one_line(capsys, error, line):
    def command():
        raise error

    assert refused_in_one_line(command, "runs") == 2 and capsys.readouterr().err == line
    assert refused_in_one_line(lambda: 130, "runs") == 130
