"""Command lines of the commands that read finished runs: `RUNS...` or one `RUN`, and a few flags.

Errors are one line. Nothing here imports JAX, so that a typing error is reported at once.
"""

import argparse
import difflib
import os
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from experiments.running import files
from experiments.surroundings import paths, streams

# Exit codes of all commands; their meaning: experiments/README.md.
DONE, FAILED, BAD_USAGE, DIVERGED, INTERRUPTED = 0, 1, 2, 3, 130


class UsageError(ValueError):
    """An invalid command line. The text is one line that names the flag or the run."""


class Parser(argparse.ArgumentParser):
    """argparse with this repository's messages: one line, `--flag: expects ...`.

    Args:
      one: whether the command expects the folder of one run, `RUN`, instead of any number of `RUNS`.
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
        self.add_argument("runs", nargs="*", type=_expanded, metavar=name, help=text)

    def read(self, argv: Sequence[str]) -> argparse.Namespace:
        """The values of `argv`, program name first. Exits with 0 after --help. Raises `UsageError`."""
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
        """Raises `UsageError` with argparse's message in this repository's form."""
        flag, _, rest = message.removeprefix("argument ").partition(": ")
        if "expected one argument" in rest:
            rest = _expectation(next(action for action in self._actions if flag in action.option_strings))
        elif "ignored explicit argument" in rest:
            rest = "is a switch and expects no value"
        raise UsageError(f"{flag}: {rest}" if rest else message)


def _expectation(action: argparse.Action) -> str:
    """The words of a flag's type about the expected value, from its message for an empty text."""
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


def between(low: int, high: int) -> Callable[[str], int]:
    """The type of a flag that expects a whole number from `low` to `high`."""

    def parse(text: str) -> int:
        # int() raises for texts of thousands of digits
        if not (text.isascii() and text.isdecimal() and len(text) < 20 and low <= int(text) <= high):
            raise argparse.ArgumentTypeError(f"expects a whole number from {low} to {high}, not {text[:50]!r}")
        return int(text)

    return parse


def folder(text: str) -> Path:
    """The type of a flag that expects a folder, which need not exist."""
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError("expects a folder")
    return Path(_expanded(text))


def file(text: str) -> Path:
    """The type of a flag that expects a file, which need not exist."""
    if not Path(text).name or text.endswith("/") or "\0" in text:
        raise argparse.ArgumentTypeError("expects a file")
    return Path(_expanded(text))


def _expanded(text: str) -> str:
    try:
        return paths.expanded(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def reject_existing(out: Path, names: Sequence[str], overwrite: bool) -> None:
    """Raises `UsageError` if `out` is not a folder, or if files in it would be replaced without --overwrite."""
    reject_folder("--out", out)
    existing = [name for name in names if (out / name).exists() or (out / name).is_symlink()]
    if existing and not overwrite:
        raise UsageError(
            f"--out={out}: {existing[0]} already exists; expects another folder, or --overwrite replaces it"
        )
    for name in existing:
        if (out / name).is_dir():
            raise UsageError(f"--out={out}: {name} is a folder; expects a folder without it")


def reject_folder(flag: str, path: Path) -> None:
    """Raises `UsageError` if a folder could not be created or written later."""
    try:
        if path.exists() and not path.is_dir():
            raise UsageError(f"{flag}={path}: expects a folder, which this is not")
        if not _can_be_written(path):
            raise UsageError(f"{flag}={path}: expects a folder that can be written")
    except OSError as error:  # a name that is too long
        raise UsageError(f"{flag}={path}: expects a folder that can be written: {error.strerror}") from None


def _can_be_written(folder: Path) -> bool:
    """Whether files can be created in a folder or, if it does not exist, the folder itself can be created.

    Raises `OSError` with the reason where the system says no only when it is tried, as in /proc.
    """
    nearest = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.exists())
    if not (nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)):
        return False
    with tempfile.TemporaryDirectory(prefix=".sqt_jax_", dir=nearest):
        return True


def write_file(out: Path, content: bytes) -> None:
    """Writes a file, and creates its folders. Raises `UsageError` if that fails."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with files.atomic_file(out) as stream:
            stream.write(content)
    except OSError as error:
        raise UsageError(f"--out={out}: expects a file that can be written: {error.strerror}") from None


def reject_file(flag: str, path: Path, overwrite: bool) -> None:
    """Raises `UsageError` if a file could not be written later, or exists and `overwrite` is false."""
    try:
        if path.is_dir():
            raise UsageError(f"{flag}={path}: expects a file, which this folder is not")
        if os.path.lexists(path) and not overwrite:
            raise UsageError(f"{flag}={path}: already exists; expects another file, or --overwrite replaces it")
        if not _can_be_written(path.parent):
            raise UsageError(f"{flag}={path}: expects a file in a folder that can be written")
    except OSError as error:  # a name that is too long
        raise UsageError(f"{flag}={path}: expects a file that can be written: {error.strerror}") from None


def write_files(out: Path, contents: Mapping[str, bytes]) -> None:
    """Writes files into the folder `out`. Raises `UsageError` if that fails."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            with files.atomic_file(out / name) as file:
                file.write(content)
    except OSError as error:
        raise UsageError(f"--out={out}: expects a folder that can be written: {error.strerror}") from None


def printable(text: str, kept: str = "") -> str:
    """`text` with escapes for unprintable characters (control characters, lone surrogates) not in `kept`."""
    return "".join(c if c.isprintable() or c in kept else repr(c)[1:-1] for c in text)


def guarded(command: Callable[[Sequence[str]], Any], argv: Sequence[str]) -> int:
    """Runs a command and returns its exit code. A `UsageError` becomes one line on stderr.

    Output that could not be printed is a failure, except if its reader left (`| head`).
    """
    try:
        command(argv)
        if lost := streams.lost_output():
            print(f"the output could not be written: {lost}", file=sys.stderr)
            return FAILED
    except UsageError as error:
        print(printable(str(error)), file=sys.stderr)
        return BAD_USAGE
    except SystemExit as left:  # after --help
        return left.code if isinstance(left.code, int) else BAD_USAGE
    return DONE
