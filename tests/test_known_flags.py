"""Flags of commands that pass others on to the runs."""

import pytest
from absl import flags

from experiments.commandline.known_flags import parse_known


@pytest.fixture(autouse=True)
def own_flags(monkeypatch):
    """A command with a switch and a number, and none of the flags that libraries define."""
    values = flags.FlagValues()
    flags.DEFINE_bool("switch", False, "A switch.", flag_values=values)
    flags.DEFINE_integer("workers", None, "A number.", 1, flag_values=values)
    monkeypatch.setattr(flags, "FLAGS", values)


def test_other_flags_are_handed_back():
    assert parse_known(["sweep", "--workers=2", "--lr=1", "--switch"]) == ["sweep", "--lr=1"]


@pytest.mark.parametrize(
    ("word", "line"),
    [
        ("--switch=x", "--switch: expects true or false\n"),
        ("--workers=x", "--workers: expects a positive integer\n"),
        ("--workers=0", "--workers: expects a positive integer\n"),
    ],
)
def test_a_wrong_value_is_one_line(capsys, word, line):
    with pytest.raises(SystemExit) as left:
        parse_known(["sweep", word])
    assert left.value.code == 2 and capsys.readouterr().err == line
