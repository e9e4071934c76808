"""Rows of a table are in the file at once, and a full disk or a crash loses none."""

import errno
import os

import pytest

from experiments.running import csv_rows
from experiments.running.csv_rows import CsvTable, MissingRows, WrongColumns

COLUMNS = ["step", "value"]
HEADER = "step,value\n"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "table.csv"


@pytest.fixture
def disk(monkeypatch):
    """A disk with room for `disk["room"]` more bytes; None: for all."""
    left = {"room": None}

    def pwrite(file, data, offset, original=os.pwrite):
        if left["room"] is None:
            return original(file, data, offset)
        if not left["room"]:
            raise OSError(errno.ENOSPC, "No space left on device")
        return original(file, data[: left["room"]], offset)

    monkeypatch.setattr(csv_rows.os, "pwrite", pwrite)
    return left


def test_a_row_is_in_the_file_when_write_returns(path):
    table = CsvTable(path, 0, COLUMNS)
    assert path.read_text() == HEADER
    assert table.write({"step": 1, "value": float("nan")}) and path.read_text() == HEADER + "1,\n"
    assert table.write({"step": 2, "value": 0.5}) and table.length() == path.stat().st_size
    table.close()
    assert path.read_text() == HEADER + "1,\n2,0.5\n"


@pytest.mark.parametrize("room", [0, 2])
def test_rows_wait_while_the_disk_is_full_and_none_is_written_in_part(path, disk, room):
    table = CsvTable(path, 0, COLUMNS)
    table.write({"step": 1, "value": 1})
    before, disk["room"] = path.read_text(), room
    assert not table.write({"step": 2, "value": 2}) and not table.write({"step": 3, "value": 3})
    assert path.read_text() == before
    with pytest.raises(OSError, match="No space left"):
        table.length()
    disk["room"] = None
    assert table.write({"step": 4, "value": 4})
    assert path.read_text() == before + "2,2\n3,3\n4,4\n"


def test_an_existing_file_keeps_the_given_number_of_bytes(path):
    path.write_text(HEADER + "1,1\n2,2\n")
    table = CsvTable(path, len(HEADER + "1,1\n"), COLUMNS)
    assert path.read_text() == HEADER + "1,1\n"
    table.write({"step": 3, "value": 3})
    assert path.read_text() == HEADER + "1,1\n3,3\n"
    CsvTable(path, 0, COLUMNS)
    assert path.read_text() == HEADER


def test_a_file_with_lost_rows_or_other_columns_is_not_changed(path):
    path.write_text(HEADER + "1,1\n")
    with pytest.raises(MissingRows, match="^table.csv$"):
        CsvTable(path, 100, COLUMNS)
    with pytest.raises(WrongColumns, match="^table.csv$"):
        CsvTable(path, len(HEADER), ["step", "other"])
    assert path.read_text() == HEADER + "1,1\n"


def test_a_link_is_not_followed(path):
    (path.parent / "mine").write_text("x")
    path.symlink_to(path.parent / "mine")
    with pytest.raises(OSError):
        CsvTable(path, 0, COLUMNS)
    assert (path.parent / "mine").read_text() == "x"
