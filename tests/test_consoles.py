"""Consoles: live lines on terminals only, tables as wide as they need elsewhere."""

import io

import pytest
from rich.table import Table

from experiments.surroundings import consoles


@pytest.mark.parametrize("variables", [{}, {"COLUMNS": "20"}, {"FORCE_COLOR": "1", "TTY_COMPATIBLE": "1"}])
def test_a_file_gets_plain_wide_tables(monkeypatch, capsys, variables):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    console = consoles.console()
    assert not console.is_terminal
    table = Table("a" * 100, "b" * 100)
    table.add_row("10,234.5 +- 698.4", "[bold]")
    console.print(table)
    text = capsys.readouterr().out
    assert "a" * 100 in text and "b" * 100 in text and "10,234.5 +- 698.4" in text and "\x1b" not in text


def test_a_terminal_has_its_own_width(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setenv("COLUMNS", "47")
    monkeypatch.setattr("sys.stderr", Terminal())
    console = consoles.console(stderr=True)
    assert console.is_terminal and console.width == 47
