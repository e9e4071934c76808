"""Standard streams that never end a run: a full disk, a closed pipe or a character that cannot be encoded."""

import errno
import io
import os
import select
import sys
from typing import Any, TextIO

_lost: dict[int, OSError] = {}  # file descriptor -> why its last output was lost


class _Lenient(io.FileIO):
    """A file that drops what it cannot write."""

    def write(self, data: Any) -> int:
        content = memoryview(data)
        try:
            written = super().write(content)
            while written is None:  # the stream does not block, and its reader is slow
                select.select([], [self.fileno()], [])
                written = super().write(content)
            return written
        except OSError as error:
            _lost[self.fileno()] = error
            return content.nbytes


def guard() -> None:
    """Replaces `sys.stdout` and `sys.stderr` of a process that has just started.

    Output that cannot be written is dropped (`lost_output`). Characters that the stream cannot encode are escaped. A
    stream that was closed goes nowhere: else the next file would get its number, and output of libraries with it.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number
    sys.stdout, sys.stderr = _guarded(1, sys.stdout), _guarded(2, sys.stderr)


def lost_output() -> str | None:
    """Why output on stdout was lost, in words; None if nothing was, or if its reader left (`| head`)."""
    sys.stdout.flush()
    error = _lost.get(1)
    return None if error is None or error.errno == errno.EPIPE else error.strerror


def _guarded(descriptor: int, stream: TextIO | None) -> io.TextIOWrapper:
    interactive = os.isatty(descriptor)
    return io.TextIOWrapper(
        io.BufferedWriter(_Lenient(descriptor, "w", closefd=False)),
        encoding=getattr(stream, "encoding", None) or "utf-8",
        errors="backslashreplace",
        line_buffering=interactive or descriptor == 2,
        write_through=getattr(stream, "write_through", False),  # PYTHONUNBUFFERED
    )
