"""Command lines of the commands that read runs: flags, error lines, exit codes, written files."""

import argparse
from pathlib import Path

import pytest

from experiments.commandline import arguments
from experiments.commandline.arguments import Parser, UsageError, between, folder, guarded, one_of, reject_file


@pytest.fixture
def parser():
    made = Parser("What it does.", "python -m experiments.tables RUNS...")
    made.add_argument("--format", type=one_of("png", "svg"), default="png", metavar="NAME")
    made.add_argument("--seed", type=between(0, 99), default=0, metavar="N")
    made.add_argument("--out", type=folder, metavar="FOLDER")
    made.add_argument("--camera", metavar="NAME")
    made.add_argument("--overwrite", action="store_true")
    return made


def test_runs_and_flags_in_any_order(parser):
    options = parser.read(["plots", "--seed=3", "a", "--format=svg", "b", "--overwrite", "c"])
    assert options.runs == ["a", "b", "c"]
    assert (options.format, options.seed, options.out, options.overwrite) == ("svg", 3, None, True)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "RUNS: expects folders of runs or folders above them, as in python -m experiments.tables RUNS..."),
        (["a", "--formt=svg"], "--formt: unknown flag; did you mean --format?"),
        (["a", "--xyz"], "--xyz: unknown flag; --help lists the flags"),
        (["a", "--form=svg"], "--form: unknown flag; did you mean --format?"),  # no abbreviations
        (["a", "--format=gif"], "--format: expects one of png, svg, not 'gif'"),
        (["a", "--format"], "--format: expects one of png, svg"),
        (["a", "--seed", "--overwrite"], "--seed: expects a whole number from 0 to 99"),
        (["a", "--out"], "--out: expects a folder"),
        (["a", "--camera"], "--camera: expects a name"),
        (["a", "--seed=-1"], "--seed: expects a whole number from 0 to 99, not '-1'"),
        (["a", "--out="], "--out: expects a folder"),
        (["a", "--overwrite=yes"], "--overwrite: is a switch and expects no value"),
    ],
)
def test_invalid_arguments_are_rejected_in_one_line(parser, argv, message):
    with pytest.raises(UsageError) as error:
        parser.read(["tables", *argv])
    assert str(error.value) == message


def test_exit_codes(parser, capsys):
    def reject(argv):
        raise UsageError("--out=a\nb: no")

    assert guarded(reject, []) == 2
    assert capsys.readouterr().err == "--out=a\\nb: no\n"
    assert guarded(parser.read, ["tables", "--help"]) == 0
    shown = capsys.readouterr().out
    assert "What it does." in shown and "--overwrite" in shown
    assert guarded(parser.read, ["tables", "a"]) == 0


def test_files_are_replaced_only_with_overwrite(tmp_path):
    out = tmp_path / "new" / "tables"
    arguments.reject_existing(out, ["a.csv"], overwrite=False)
    arguments.write_files(out, {"a.csv": b"1"})
    with pytest.raises(UsageError, match="a.csv already exists; expects another folder, or --overwrite replaces it"):
        arguments.reject_existing(out, ["b.csv", "a.csv"], overwrite=False)
    arguments.reject_existing(out, ["a.csv"], overwrite=True)
    arguments.write_files(out, {"a.csv": b"2"})
    assert [(path.name, path.read_bytes()) for path in out.iterdir()] == [("a.csv", b"2")]


def test_folders_that_cannot_be_written(tmp_path):
    file = tmp_path / "file"
    file.write_text("x")
    with pytest.raises(UsageError, match="expects a folder, which this is not"):
        arguments.reject_existing(file, ["a.csv"], overwrite=True)
    for out in (file / "below", file / "below" / "further", tmp_path / ("x" * 300)):
        with pytest.raises(UsageError, match="^--out=.*: expects a folder that can be written"):
            arguments.reject_existing(out, ["a.csv"], overwrite=True)
        with pytest.raises(UsageError, match="^--out=.*: expects a folder that can be written"):
            arguments.write_files(out, {"a.csv": b""})
    (tmp_path / "a.csv").mkdir()
    with pytest.raises(UsageError, match="a.csv is a folder"):
        arguments.reject_existing(tmp_path, ["a.csv"], overwrite=True)


def test_a_folder_is_checked_by_writing(tmp_path):
    """The system says that root may write into /proc, and refuses when it does."""
    arguments.reject_folder("--out", tmp_path / "a" / "b")
    assert not any(tmp_path.iterdir())
    if Path("/proc/self").exists():
        with pytest.raises(UsageError, match="^--out=/proc/x: expects a folder that can be written"):
            arguments.reject_folder("--out", Path("/proc/x"))


def test_a_link_is_replaced_and_not_written_through(tmp_path):
    (tmp_path / "precious").write_text("x")
    (tmp_path / "a.csv").symlink_to(tmp_path / "precious")
    with pytest.raises(UsageError):
        arguments.reject_existing(tmp_path, ["a.csv"], overwrite=False)
    arguments.write_files(tmp_path, {"a.csv": b"1"})
    assert (tmp_path / "precious").read_text() == "x" and not (tmp_path / "a.csv").is_symlink()


def test_a_file_is_written_completely(tmp_path):
    out = tmp_path / "new" / "report.html"
    for content in (b"1", b"2"):
        arguments.write_file(out, content)
        assert out.read_bytes() == content and [*out.parent.iterdir()] == [out]
    for path in (tmp_path, out / "below.html", tmp_path / ("x" * 300)):
        with pytest.raises(UsageError, match="--out=.*: expects a file"):
            arguments.write_file(path, b"")


@pytest.mark.parametrize("text", ["", ".", "/", "folder/", "a\0b"])
def test_paths_that_cannot_be_a_file(text):
    with pytest.raises(argparse.ArgumentTypeError, match="expects a file"):
        arguments.file(text)


def test_unprintable_characters_are_escaped():
    assert arguments.printable("a\x1b[1m\n\u202e\ud800é", kept="\n") == "a\\x1b[1m\n\\u202e\\ud800é"


def test_a_command_for_one_run_expects_one():
    made = Parser("What it does.", "python -m experiments.play RUN --video=FILE", one=True)
    made.add_argument("--seed", type=between(0, 9), metavar="N")
    assert made.prog == "python -m experiments.play"
    options = made.read(["play", "a", "--seed=9"])
    assert (options.runs, options.seed) == (["a"], 9)
    for runs in ([], ["a", "b"]):
        with pytest.raises(
            UsageError, match="RUN: expects the folder of one run, as in python -m experiments.play RUN"
        ):
            made.read(["play", *runs])
    for text in ("10", "-1", "1.0", "", "9" * 5000):
        with pytest.raises(UsageError, match="--seed: expects a whole number from 0 to 9, not"):
            made.read(["play", "a", f"--seed={text}"])


def test_a_file_that_could_not_be_written_is_rejected_in_advance(tmp_path):
    reject_file("--video", tmp_path / "new" / "folder" / "film.mp4", overwrite=False)
    (tmp_path / "film.mp4").write_text("x")
    (tmp_path / "link.mp4").symlink_to("nowhere")
    (tmp_path / "folder.mp4").mkdir()
    for name in ("film.mp4", "link.mp4"):
        reject_file("--video", tmp_path / name, overwrite=True)
        with pytest.raises(UsageError, match=f"--video=.*/{name}: already exists; expects another file, or --over"):
            reject_file("--video", tmp_path / name, overwrite=False)
    cannot = {
        "folder.mp4": "expects a file, which this folder is not",
        "film.mp4/film.mp4": "expects a file in a folder that can be written",
        "x" * 300 + ".mp4": "expects a file that can be written: File name too long",
    }
    for name, message in cannot.items():
        with pytest.raises(UsageError, match=message):
            reject_file("--video", tmp_path / name, overwrite=True)
