"""The formats of films by a file's ending. Imports no other package, so that flags are checked at once."""

from pathlib import Path

FORMATS = ("mp4", "gif", "html")


def format_of(path: Path) -> str:
    """The format of a film by its file's ending, one of `FORMATS`.

    Raises:
      ValueError: another ending.
    """
    suffix = path.suffix.lower().removeprefix(".")
    if suffix not in FORMATS or not path.stem:
        raise ValueError(f"expects a file with the ending {', '.join(f'.{name}' for name in FORMATS)}")
    return suffix
