"""Keeps the record of a lock alive: a thread that rewrites it, and notices when another process has replaced it."""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from experiments.commandline.arguments import INTERRUPTED, printable
from experiments.running import files, lock_record
from experiments.running.lock_record import Record

JOIN_BEATS = 4  # how long the end waits for the thread, in beats: a file server may hang


def end_process(line: str) -> None:
    """Prints a line on stderr and ends this process at once, with exit code 130."""
    with suppress(OSError):
        os.write(2, f"{printable(line)}\n".encode("ascii", "backslashreplace"))
    # An exception would end its thread only, and a signal would let the run write a checkpoint first.
    os._exit(INTERRUPTED)


@contextmanager
def renewed(
    path: Path,
    own: Record,
    first: float,
    beat: float,
    warn: Callable[[str], None],
    lost: Callable[[str], None] = end_process,
) -> Iterator[None]:
    """Rewrites a record while the body runs, and marks it as released at the end.

    A failure to write costs a warning, not the run.

    Args:
      path: the file `lock`, with the record `own`.
      first, beat: seconds until the first and between the following rewrites.
      warn: called with a line of text when the record cannot be written for the first time, from another thread.
      lost: called with a line of text, from another thread, when the file has another process's record. Nothing is
        written from then on.
    """
    end = threading.Event()

    def renew() -> None:
        beats, warned = 0, False
        while not end.wait(beat if beats else first):
            beats += 1
            try:
                other = _rewrite(path, own._replace(beat=beats))
            except OSError as error:
                if not warned:
                    warned = True
                    with suppress(OSError, ValueError):  # a closed stream
                        warn(_cannot_renew(path, error))
                continue
            if other:
                lost(f"{path.parent}: {other} has taken over this run; this process ends")
                return

    thread = threading.Thread(target=renew, daemon=True)
    try:
        thread.start()
    except RuntimeError as error:  # the system allows no more threads
        warn(_cannot_renew(path, error))
    try:
        yield
    finally:
        end.set()
        if thread.ident is not None:
            thread.join(JOIN_BEATS * beat)
        if not thread.is_alive():
            with suppress(OSError):
                _rewrite(path, own._replace(released=True))


def _cannot_renew(path: Path, error: Exception) -> str:
    return f"{path} cannot be renewed ({error}): start no other process on this run"


def _rewrite(path: Path, record: Record) -> Record | None:
    """Writes a record over one with the same token; returns another process's record, which is left as it is.

    An empty or damaged record is replaced: no process leaves one.
    """
    # Opened each time, so that what another host has written is seen, and a file that has replaced this one.
    descriptor = lock_record.open_file(path, os.O_RDWR)
    try:
        found = lock_record.decode(os.pread(descriptor, lock_record.RECORD_BYTES + 1, 0))
        if found and found.token != record.token:
            return found
        os.pwrite(descriptor, lock_record.encode(record), 0)
        files.sync_open(descriptor)
        return None
    finally:
        os.close(descriptor)
