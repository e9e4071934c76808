"""Files that are complete or absent, folders locked by one process, and reading JSON that may be damaged."""

import fcntl
import json
import math
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

MAX_DEPTH = 20  # of nested JSON


class Busy(Exception):
    """Another process has locked the folder. `process` is its id, empty if unknown."""

    def __init__(self, process: str):
        super().__init__(process)
        self.process = process


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Locks `folder` for this process, by the file `lock` in it. The system unlocks it when the process ends.

    Raises:
      Busy: another process has locked it.
      OSError: the folder or the file `lock` cannot be created.
    """
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Busy(os.pread(descriptor, 20, 0).decode("ascii", "replace").strip()) from None
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write that gets the name `path` when it is complete and on disk, replacing an existing file."""
    part = path.with_name(path.name + ".part")
    part.unlink(missing_ok=True)  # else an existing link would be followed
    try:
        with part.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def sync(path: Path) -> None:
    """Returns when a file's content, or a folder's list of names, is on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
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
