"""Files that are complete or absent, new folders, and reading JSON that may be damaged."""

import json
import os
import zlib
from pathlib import Path

import pytest

from experiments.running import files


@pytest.mark.parametrize("number", files.NOT_SUPPORTED)
def test_a_file_system_without_fsync_is_used(tmp_path, monkeypatch, number):
    def refuse(*arguments):
        raise OSError(number, "not supported")

    monkeypatch.setattr(files.os, "fsync", refuse)
    with files.atomic_file(tmp_path / "a") as file:
        file.write(b"content")
    files.sync(tmp_path)
    assert (tmp_path / "a").read_bytes() == b"content"


def test_new_folders_have_different_names(tmp_path):
    made = [files.new_folder(tmp_path / "a" / "run") for _ in range(3)]
    assert [path.name for path in made] == ["run", "run-2", "run-3"] and all(path.is_dir() for path in made)


def test_a_file_gets_its_name_when_it_is_complete(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    with files.atomic_file(path) as file:
        file.write(b"new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert [item.name for item in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
@pytest.mark.parametrize("before", ["old", None])
def test_a_file_that_cannot_be_finished_leaves_nothing(tmp_path, error, before):
    path = tmp_path / "file"
    if before:
        path.write_text(before)
    with pytest.raises(error), files.atomic_file(path) as file:
        file.write(b"new")
        raise error
    assert {item.name: item.read_text() for item in tmp_path.iterdir()} == ({"file": before} if before else {})


@pytest.mark.parametrize("name", ["file", "file.part"])
def test_a_link_is_replaced_and_not_written_through(tmp_path, name):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / name).symlink_to(tmp_path / "mine")
    with files.atomic_file(tmp_path / "file") as file:
        file.write(b"new")
    assert (tmp_path / "mine").read_text() == "mine"
    assert (tmp_path / "file").read_text() == "new" and not (tmp_path / "file").is_symlink()
    assert not os.path.lexists(tmp_path / "file.part")


def test_files_below_a_folder(tmp_path):
    outside, folder = tmp_path / "outside", tmp_path / "folder"
    (folder / "a" / "b").mkdir(parents=True)
    outside.mkdir()
    (outside / "secret").write_text("")
    for name in ("file", "a/file", "a/b/file"):
        (folder / name).write_text("")
    (folder / "a" / "to_folder").symlink_to(outside)
    (folder / "to_file").symlink_to(outside / "secret")
    (folder / "to_itself").symlink_to(folder)
    names = {"file", "a/file", "a/b/file", "a/to_folder", "to_file", "to_itself"}
    assert files.below(folder) == {name: folder / name for name in names}
    assert files.below(tmp_path / "none") == files.below(folder / "to_itself") == {}


def test_crc_is_that_of_all_bytes(tmp_path):
    content = os.urandom((1 << 20) + 7)  # more than one piece
    (tmp_path / "file").write_bytes(content)
    assert files.crc(tmp_path / "file") == zlib.crc32(content)


def test_json_is_read_up_to_its_limits(tmp_path):
    value = {"list": [1, 2.5, None, "text"], "deep": json.loads("[" * 18 + "]" * 18)}
    text = json.dumps(value)
    (tmp_path / "file").write_text(text)
    assert files.read_json(tmp_path / "file", len(text)) == value
    with pytest.raises(ValueError, match="more than"):
        files.read_json(tmp_path / "file", len(text) - 1)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"{} {}",
        b"NaN",
        b"-Infinity",
        b"1e999",
        b"\xff\xfe",
        b"[" * 25 + b"]" * 25,
        b'{"a":' * 25 + b"1" + b"}" * 25,
        b"[" * 100_000,
        b"1" * 5000,
    ],
    ids=lambda content: repr(content)[1:12],
)
def test_invalid_json_is_rejected(tmp_path, content):
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(ValueError):
        files.read_json(tmp_path / "file", 1_000_000)


def test_only_files_are_read_as_json(tmp_path):
    (tmp_path / "file").write_text("{}")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "fifo")
    for name in ("link", "folder", "fifo", "none"):
        with pytest.raises(FileNotFoundError):
            files.read_json(tmp_path / name, 100)
    with pytest.raises(FileNotFoundError):
        files.read_json(Path("/dev/zero"), 100)
