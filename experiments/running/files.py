"""Files that are complete or absent, new folders, and reading JSON that may be damaged."""

import errno
import itertools
import json
import math
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

MAX_DEPTH = 20  # of nested JSON
# What a file system answers that has no such service: NFS without its lock daemon, FUSE, some clusters' own.
NOT_SUPPORTED = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL}


def new_folder(path: Path) -> Path:
    """Creates `path`, or the first of `path-2`, `path-3`, ... that does not exist yet, and returns it.

    Two processes never get the same folder. Raises `OSError` if none can be created.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        folder = path if number == 1 else path.with_name(f"{path.name}-{number}")
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            continue
    raise AssertionError


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write that gets the name `path` when it is complete and on disk, replacing an existing file."""
    part = path.with_name(path.name + ".part")
    part.unlink(missing_ok=True)  # else an existing link would be followed
    try:
        with part.open("xb") as file:
            yield file
            file.flush()
            sync_open(file.fileno())
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def sync_open(descriptor: int) -> None:
    """Returns when an open file is on disk, or at once where the file system cannot say. Raises `OSError`."""
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in NOT_SUPPORTED:
            raise


def sync(path: Path) -> None:
    """Returns when a file's content, or a folder's list of names, is on disk, as `sync_open`."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        sync_open(descriptor)
    finally:
        os.close(descriptor)


def crc(path: Path) -> int:
    """CRC-32 of a file."""
    value = 0
    with path.open("rb") as file:
        while piece := file.read(1 << 20):
            value = zlib.crc32(piece, value)
    return value


def below(folder: Path) -> dict[str, Path]:
    """The files below a folder by their path in it. Links are included and not followed; `folder` may not be one."""
    found: dict[str, Path] = {}
    if folder.is_symlink():
        return found
    for parent, folders, names in os.walk(folder):
        for name in [*names, *(name for name in folders if Path(parent, name).is_symlink())]:
            path = Path(parent, name)
            found[path.relative_to(folder).as_posix()] = path
    return found


def read_json(path: Path, limit: int) -> Any:
    """The content of a JSON file of at most `limit` bytes.

    Raises:
      ValueError: it is too large, too deep or not JSON, which has no NaN or infinity.
      OSError: it is a link or not a file, or cannot be read.
    """
    if path.is_symlink() or not path.is_file():
        raise FileNotFoundError(2, "No such file", str(path))
    with path.open("rb") as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise ValueError(f"more than {limit:,} bytes")
    try:
        value = json.loads(content, parse_constant=_finite, parse_float=_finite)
    except RecursionError:
        raise ValueError("too deep") from None
    if _is_deep(value):
        raise ValueError("too deep")
    return value


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value


def _is_deep(value: Any) -> bool:
    level = [value]
    for _ in range(MAX_DEPTH):
        inner = [item.values() if isinstance(item, dict) else item for item in level if isinstance(item, dict | list)]
        level = [item for items in inner for item in items]
    return bool(level)
