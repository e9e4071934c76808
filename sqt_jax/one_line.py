"""Exceptions as one line, for messages."""

import traceback
from pathlib import Path


def one_line(error: BaseException, limit: int = 300) -> str:
    """Type and message of an error, at most `limit` characters."""
    try:
        text = f"{type(error).__name__}: {error}"
    except Exception:  # of the error's own `__str__`
        text = type(error).__name__
    return " ".join(text.split()).removesuffix(":")[:limit]


def with_place(error: BaseException, ours: str) -> str:
    """`one_line`, and the file and line in the user's code that raised the error.

    Args:
      ours: the file whose own frames are not named.
    """
    last = traceback.extract_tb(error.__traceback__)[-1]
    hidden = last.filename == ours or "importlib" in last.filename
    return one_line(error) + ("" if hidden else f" ({Path(last.filename).name}, line {last.lineno})")
