"""A cell's files next to its run's folder."""

import os
from pathlib import Path

import pytest

from experiments.launchers.cell import Cell, Ended, read_ended, write_ended


def cell(path):
    return Cell(task="ant", algo="td3", path=Path(path), command=())


def test_files_are_next_to_the_run():
    assert cell("runs/ant/td3/a").log == Path("runs/ant/td3/a.log.txt")
    assert cell("runs/ant/td3/a").ended_file == Path("runs/ant/td3/a.ended.json")
    assert cell("a").label == "td3 on ant"


def test_long_names_have_short_files_that_differ():
    one, other = cell("x" * 190 + "1"), cell("x" * 190 + "2")
    assert one.log != other.log and len(one.ended_file.name) < 120
    assert len(os.fsencode(cell("é" * 100).log.name)) < 120


def test_how_it_ended_is_written_and_read(tmp_path):
    ended = Ended(cell(tmp_path / "run"), 1, "killed by SIGKILL", lost=True)
    assert read_ended(ended.cell) is None
    write_ended(ended)
    assert read_ended(ended.cell) == ended


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"code": "1", "reason": "", "lost": false}', '{"code": 1, "reason": 1, "lost": 0}']
)
def test_a_damaged_file_is_none(tmp_path, text):
    cell(tmp_path / "run").ended_file.write_text(text)
    assert read_ended(cell(tmp_path / "run")) is None
