"""A CSV file in which every written row survives a crash, and a full disk loses none."""

import csv
import errno
import io
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from experiments.running import files


class MissingRows(Exception):
    """A table is shorter than it was; the text is its name."""


class WrongColumns(Exception):
    """A table has other columns than expected; the text is its name."""


class CsvTable:
    """Rows are in the file when `write` returns. If the disk is full they wait in memory for the next `write`.

    Args:
      keep: bytes of an existing file to keep; the rest is cut off. 0: a new table.
      columns: their names.

    Raises:
      MissingRows: the file has fewer bytes than `keep`.
      WrongColumns: it has other columns.
      OSError: it cannot be created or read.
    """

    def __init__(self, path: Path, keep: int, columns: Sequence[str]):
        self._name = path.name
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        self._columns = list(columns)
        self._size = keep  # bytes of complete rows in the file
        self._waiting = b"" if keep else self._line(dict(zip(columns, columns, strict=True)))
        if os.fstat(self._file).st_size < keep:
            raise MissingRows(self._name)
        if keep and not os.pread(self._file, keep, 0).startswith(self._line(dict(zip(columns, columns, strict=True)))):
            raise WrongColumns(self._name)
        os.ftruncate(self._file, keep)
        self.flush()

    def write(self, row: Mapping[str, Any]) -> bool:
        """Adds a row; NaN becomes an empty field. Returns whether all rows so far are in the file."""
        self._waiting += self._line({name: "" if value != value else value for name, value in row.items()})
        return self.flush()

    def flush(self) -> bool:
        """Tries to write the waiting rows. Returns whether all are in the file."""
        try:
            written = os.pwrite(self._file, self._waiting, self._size)
            if written < len(self._waiting):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._file, self._size)  # no partial rows
            return False
        self._size += written
        self._waiting = b""
        return True

    def length(self) -> int:
        """Bytes of the file, once all rows are on disk.

        Raises:
          OSError: the disk has no room for them.
        """
        if not self.flush():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), self._name)
        files.sync_open(self._file)
        return self._size

    def close(self) -> None:
        """Closes the file. Waiting rows are lost."""
        os.close(self._file)

    def _line(self, row: Mapping[str, Any]) -> bytes:
        text = io.StringIO(newline="")
        csv.DictWriter(text, self._columns, restval="", lineterminator="\n").writerow(row)
        return text.getvalue().encode()
