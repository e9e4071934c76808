"""Command lines that look at finished runs: `RUNS...` or one `RUN`, and a few flags, refused in one line.

Nothing here brings JAX, so that a typing error is answered at once.
"""

import argparse
import difflib
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from experiments.running import files

DONE, BAD_USAGE = 0, 2


class UsageError(ValueError):
    """A command line that cannot be. The text is one line that names the flag or the run."""


class Parser(argparse.ArgumentParser):
    """argparse with this repository's messages: one line, `--flag: expects ...`.

    Args:
      one: whether it expects the folder of one run, `RUN`, and not any number of `RUNS`.
    """

    def __init__(self, description: str, example: str, one: bool = False):
        super().__init__(
            prog=example.partition(" RUN")[0],
            description=description,
            epilog=None if one else "RUNS are run folders, or folders above them.",
            allow_abbrev=False,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        self.example, self.one = example, one
        name, text = ("RUN", "the folder of a run") if one else ("RUNS", "folders of runs, or folders above them")
        self.add_argument("runs", nargs="*", metavar=name, help=text)

    def read(self, argv: Sequence[str]) -> argparse.Namespace:
        """The values of `argv`, program name first; leaves with 0 where it asks for help. Raises `UsageError`."""
        options, unknown = self.parse_known_intermixed_args(list(argv[1:]))
        if unknown:
            name = unknown[0].partition("=")[0]
            known = [flag for action in self._actions for flag in action.option_strings if flag.startswith("--")]
            near = difflib.get_close_matches(name, known, n=1)
            raise UsageError(
                f"{name}: unknown flag{f'; did you mean {near[0]}?' if near else '; --help lists the flags'}"
            )
        if self.one and len(options.runs) != 1:
            raise UsageError(f"RUN: expects the folder of one run, as in {self.example}")
        if not options.runs:
            raise UsageError(f"RUNS: expects folders of runs or folders above them, as in {self.example}")
        return options

    def error(self, message: str) -> NoReturn:
        flag, _, rest = message.removeprefix("argument ").partition(": ")
        if "expected one argument" in rest:
            rest = _takes(next(action for action in self._actions if flag in action.option_strings))
        elif "ignored explicit argument" in rest:
            rest = "is a switch and expects no value"
        raise UsageError(f"{flag}: {rest}" if rest else message)


def _takes(action: argparse.Action) -> str:
    """What a flag expects, as its type says of no text at all."""
    try:
        if callable(action.type):
            action.type("")
    except argparse.ArgumentTypeError as error:
        return str(error).removesuffix(", not ''")
    return f"expects a {str(action.metavar).lower()}"


def one_of(*choices: str) -> Callable[[str], str]:
    """The type of a flag that expects one of a few words."""

    def parse(text: str) -> str:
        if text not in choices:
            raise argparse.ArgumentTypeError(f"expects one of {', '.join(choices)}, not {text!r}")
        return text

    return parse


def whole(text: str) -> int:
    """The type of a flag that expects a whole number of at least 0."""
    if not (text.isascii() and text.isdecimal()):
        raise argparse.ArgumentTypeError(f"expects a whole number of at least 0, not {text!r}")
    return int(text)


def between(low: int, high: int) -> Callable[[str], int]:
    """The type of a flag that expects a whole number from `low` to `high`."""

    def parse(text: str) -> int:
        # Python refuses to read far more digits than any limit has
        if not (text.isascii() and text.isdecimal() and len(text) < 20 and low <= int(text) <= high):
            raise argparse.ArgumentTypeError(f"expects a whole number from {low} to {high}, not {text[:50]!r}")
        return int(text)

    return parse


def folder(text: str) -> Path:
    """The type of a flag that expects a folder, which need not be there."""
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError("expects a folder")
    return Path(text)


def file(text: str) -> Path:
    """The type of a flag that expects a file, which need not be there."""
    if not Path(text).name or text.endswith("/") or "\0" in text:
        raise argparse.ArgumentTypeError("expects a file")
    return Path(text)


def refuse_existing(out: Path, names: Sequence[str], overwrite: bool) -> None:
    """Raises `UsageError` where files would be replaced that may not be, or `out` is no folder."""
    refuse_folder("--out", out)
    there = [name for name in names if (out / name).exists() or (out / name).is_symlink()]
    if there and not overwrite:
        raise UsageError(
            f"--out={out}: {there[0]} is there already; expects another folder, or --overwrite replaces it"
        )
    for name in there:
        if (out / name).is_dir():
            raise UsageError(f"--out={out}: {name} is a folder; expects a folder without it")


def refuse_folder(flag: str, path: Path) -> None:
    """Raises `UsageError` where a folder could not be made or written later."""
    try:
        if path.exists() and not path.is_dir():
            raise UsageError(f"{flag}={path}: expects a folder, which this is not")
        if not _can_be_written(path):
            raise UsageError(f"{flag}={path}: expects a folder that can be written")
    except OSError as error:  # a name that is too long
        raise UsageError(f"{flag}={path}: expects a folder that can be written: {error.strerror}") from None


def _can_be_written(folder: Path) -> bool:
    """Whether files can be made in a folder, or the folder itself, where it is not there yet."""
    nearest = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.exists())
    return nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)


def write_file(out: Path, content: bytes) -> None:
    """Writes a whole file, and the folders it lies in. Raises `UsageError` where that cannot be."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with files.whole_file(out) as stream:
            stream.write(content)
    except OSError as error:
        raise _unwritable(out, error) from None


def _unwritable(out: Path, error: OSError) -> UsageError:
    return UsageError(f"--out={out}: expects a file that can be written: {error.strerror}")


def refuse_file(flag: str, path: Path, overwrite: bool) -> None:
    """Raises `UsageError` where a file could not be written later, or would replace one that it may not."""
    try:
        if path.is_dir():
            raise UsageError(f"{flag}={path}: expects a file, which this folder is not")
        if os.path.lexists(path) and not overwrite:
            raise UsageError(f"{flag}={path}: is there already; expects another file, or --overwrite replaces it")
        if not _can_be_written(path.parent):
            raise UsageError(f"{flag}={path}: expects a file in a folder that can be written")
    except OSError as error:  # a name that is too long
        raise UsageError(f"{flag}={path}: expects a file that can be written: {error.strerror}") from None


def write_files(out: Path, contents: Mapping[str, bytes]) -> None:
    """Writes whole files into `out`. Raises `UsageError` where that cannot be."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            with files.whole_file(out / name) as file:
                file.write(content)
    except OSError as error:
        raise UsageError(f"--out={out}: expects a folder that can be written: {error.strerror}") from None


def printable(text: str, kept: str = "") -> str:
    """With escapes for what is not to be seen, such as control characters and halves of surrogates, but for `kept`."""
    return "".join(c if c.isprintable() or c in kept else repr(c)[1:-1] for c in text)


def guarded(command: Callable[[Sequence[str]], Any], argv: Sequence[str]) -> int:
    """Runs a command; the exit code. A `UsageError` is one line on stderr."""
    try:
        command(argv)
    except UsageError as error:
        print(printable(str(error)), file=sys.stderr)
        return BAD_USAGE
    except SystemExit as left:  # after --help
        return left.code if isinstance(left.code, int) else BAD_USAGE
    return DONE
