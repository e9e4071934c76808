"""A CSV file that outlives the process row by row, and a full disk."""

import csv
import errno
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


class Shortened(Exception):
    """A table holds less than it should; its name."""


class OtherColumns(Exception):
    """A table has other columns than it should; its name."""


class Table:
    """Rows are in the file when `write` returns; those that find no room wait for the next one.

    Of a file that exists, the first `keep` bytes stay.

    Raises:
      Shortened: it has fewer.
      OtherColumns: it has others.
      OSError: it cannot be made or read.
    """

    def __init__(self, path: Path, keep: int, columns: Sequence[str]):
        self._name = path.name
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        self._columns = list(columns)
        self._size = keep  # of what is whole
        self._waiting = b"" if keep else self._line(dict(zip(columns, columns, strict=True)))
        if os.fstat(self._file).st_size < keep:
            raise Shortened(self._name)
        if keep and not os.pread(self._file, keep, 0).startswith(self._line(dict(zip(columns, columns, strict=True)))):
            raise OtherColumns(self._name)
        os.ftruncate(self._file, keep)
        self.flush()

    def write(self, row: Mapping[str, Any]) -> bool:
        """Adds a row; NaN is an empty field. Whether there was room for it and all before."""
        self._waiting += self._line({name: "" if value != value else value for name, value in row.items()})
        return self.flush()

    def flush(self) -> bool:
        """Tries to write the rows that wait. Whether none is left."""
        try:
            written = os.pwrite(self._file, self._waiting, self._size)
            if written < len(self._waiting):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            os.ftruncate(self._file, self._size)  # no half rows
            return False
        self._size += written
        self._waiting = b""
        return True

    def length(self) -> int:
        """Bytes of the file, with all rows in it and on disk.

        Raises:
          OSError: there is no room for them.
        """
        if not self.flush():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), self._name)
        os.fsync(self._file)
        return self._size

    def close(self) -> None:
        os.close(self._file)

    def _line(self, row: Mapping[str, Any]) -> bytes:
        text = io.StringIO(newline="")
        csv.DictWriter(text, self._columns, restval="", lineterminator="\n").writerow(row)
        return text.getvalue().encode()
