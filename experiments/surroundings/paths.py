"""Paths in flags, YAML files and variables."""

import os
from pathlib import Path


def expanded(text: str) -> str:
    """`text` with a leading `~` or `~user` replaced by the home folder: the shell does not in `--out=~/runs`.

    Raises:
      ValueError: there is no such home folder; the text is one line.
    """
    if not text.startswith("~"):
        return text
    path = os.path.expanduser(text)
    home, _, rest = text.partition("/")
    if path.startswith("~") or not Path(os.path.expanduser(home)).is_dir():
        raise ValueError(f"expects a folder that exists for {home}; ./{text} names a folder called {home}")
    return path
