"""Locks a run's folder for one process, also against processes of other hosts.

Two means together. `flock` is exact and ends with its process, but some file systems have none, and on others it does
not reach other hosts (https://man7.org/linux/man-pages/man2/flock.2.html, NFS details). The record in the file `lock`
reaches every host that sees the file: its holder rewrites it every `BEAT` seconds, and a record that stays the same
for `EXPIRES` seconds is that of a dead process. Clocks of hosts are not compared.

What is guaranteed: within the reach of `flock`, one process at a time. Beyond it, of several processes one goes on:
the last that wrote its record. Each reads the file again before it starts or at its next beat, and ends if another's
record is in it. So two can overlap for up to a beat: when they start at the same moment, and when a holder wakes up
that was stopped for longer than `EXPIRES`.
"""

import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import psutil

from experiments.running import files, lock_record
from experiments.running.lock_record import Record
from experiments.running.lock_renewal import end_process, renewed

BEAT = 5.0  # seconds between two beats
EXPIRES = 20.0  # seconds without a beat after which a holder counts as dead
WAIT = 120.0  # seconds for the lock of an earlier attempt at the same job: NFS servers keep those of a dead host for 90
SETTLE = 2.0  # seconds after which a record is read again that another process may have written too
LOOKS = 10  # at a record, in EXPIRES seconds
CLOCK_TOLERANCE = 60.0  # seconds by which the clocks of this host and of a file server may differ


class Timing(NamedTuple):
    """Seconds; see the constants of these names."""

    beat: float = BEAT
    expires: float = EXPIRES
    wait: float = WAIT
    settle: float = SETTLE


TIMING = Timing()


class Busy(Exception):
    """Another process has locked the folder. The text names its host, process and job as far as they are known."""

    def __init__(self, holder: Record | None):
        # A released record is that of the last holder: the next one has the lock and has not written yet.
        self.holder = None if holder and holder.released else holder
        super().__init__(str(self.holder or "another process"))


class Holder(NamedTuple):
    """Who holds a folder. If its record cannot be read, the names are empty and `process` is None."""

    host: str
    process: int | None
    job: str  # empty: none
    alive: bool | None  # None: unknown


UNKNOWN = Holder("", None, "", None)


@contextmanager
def locked(
    folder: Path,
    warn: Callable[[str], None] = lambda line: None,
    *,
    host: str | None = None,
    timing: Timing = TIMING,
    lost: Callable[[str], None] = end_process,
) -> Iterator[None]:
    """Creates `folder` if necessary and locks it for this process, by the file `lock` in it.

    A process that was killed on this host keeps nobody out. One that has died on another host does for
    `timing.expires` seconds, unless this process is a later attempt at its job; then the lock is awaited if necessary.

    Args:
      warn: called with a line of text when the lock has to be awaited, or is not a full one. It may be called from
        another thread.
      host: the name of this host; None: the system's.
      lost: called with a line of text, from another thread, when another process has taken the folder over.

    Raises:
      Busy: another process has locked it.
      OSError: the folder or the file `lock` cannot be created, read or written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path, own = folder / "lock", lock_record.new_record(host)
    descriptor = lock_record.open_file(path, os.O_RDWR | os.O_CREAT)
    try:
        _acquire(descriptor, path, own, timing, warn)
        with renewed(path, own, timing.settle, timing.beat, warn, lost):
            yield
    finally:
        os.close(descriptor)  # ends the flock


def holder(folder: Path) -> Holder | None:
    """Who holds `folder`; None if nobody does. Only reads: to try the lock would keep out a run that starts meanwhile.

    `alive` is exact for a holder of this host. For another host's, it compares the file's time with this host's clock,
    and lets them differ by a minute: it stays true for the first 75 seconds after a kill. It is None if the file's time
    is more than a minute ahead.
    """
    try:
        content, written = lock_record.read(folder / "lock")
    except FileNotFoundError:
        return None
    except OSError:
        return UNKNOWN
    record = lock_record.decode(content)
    if not content or (record and record.released):
        return None
    if record is None:
        return UNKNOWN
    age = time.time() - written
    alive = None if age < -CLOCK_TOLERANCE else age <= 3 * BEAT + CLOCK_TOLERANCE
    if alive and record.boot and record.on_host_of(lock_record.new_record()):
        alive = _exists(record.process)
    return Holder(record.host, record.process, record.job, alive)


def _exists(process: int) -> bool:
    """Whether a process of this host has not ended."""
    try:
        return psutil.Process(process).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
    except psutil.Error:  # another user's
        return True


def _acquire(descriptor: int, path: Path, own: Record, timing: Timing, warn: Callable[[str], None]) -> None:
    """Writes `own` into the lock when nobody else holds it. Raises as `locked`."""
    has_flock = _flock(descriptor, path.parent, warn)
    awaited = has_flock is False
    if awaited:
        _await_flock(descriptor, path, own, timing, warn)
    content, _ = lock_record.read(path)
    last = lock_record.decode(content)
    # Certainly, as far as flock reaches.
    ended = not content or awaited or (last and (last.released or (has_flock and own.on_host_of(last))))
    if not ended and not own.succeeds(last):
        warn(
            f"{path} has the record of {last or 'an unknown process'}, which the system's locks may not reach: "
            f"waiting {timing.expires:g} s to see if it is alive"
        )
        _watch(path, content, timing)
    os.pwrite(descriptor, lock_record.encode(own), 0)
    os.ftruncate(descriptor, lock_record.RECORD_BYTES)
    files.sync_open(descriptor)
    if not ended or has_flock is None:
        # Until a process that lives after all has noticed the new record and ended.
        time.sleep(timing.settle + (0 if ended else timing.beat))
        found = lock_record.decode(lock_record.read(path)[0])
        if found is None or found.token != own.token:
            raise Busy(found)


def _flock(descriptor: int, folder: Path, warn: Callable[[str], None]) -> bool | None:
    """Locks an open file: True; False if another process has locked it; None if its file system has no locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in files.NOT_SUPPORTED:
            raise
        warn(
            f"the file system of {folder} has no locks ({error.strerror}): other processes are only kept off by the "
            "record in the file lock"
        )
        return None


def _await_flock(descriptor: int, path: Path, own: Record, timing: Timing, warn: Callable[[str], None]) -> None:
    """Returns with the lock that an earlier attempt at the same job has not given up yet. Raises `Busy`."""
    ends = time.monotonic() + timing.wait
    warned = False
    while True:
        try:
            found = lock_record.decode(lock_record.read(path)[0])
        except OSError:  # some file systems keep readers off a locked file
            found = None
        if not own.succeeds(found) or time.monotonic() > ends:
            raise Busy(found)
        if not warned:
            warn(f"{found}, an earlier attempt at this job, still has the lock: waiting up to {timing.wait:g} s")
            warned = True
        time.sleep(timing.expires / LOOKS)
        if _flock(descriptor, path.parent, warn):
            return


def _watch(path: Path, content: bytes, timing: Timing) -> None:
    """Returns when the file has had the same content for `timing.expires` seconds, or was released.

    Raises:
      Busy: it changed: its holder lives, or another process has taken it over.
    """
    pause = timing.expires / LOOKS
    left = LOOKS
    while left:
        time.sleep(pause)
        began = time.monotonic()
        seen, _ = lock_record.read(path)
        if seen != content:
            found = lock_record.decode(seen)
            if found and found.released:
                return
            raise Busy(found)
        # A look that took long was held up by the file server, and so were the holder's beats: the time begins again.
        left = LOOKS if time.monotonic() - began > pause else left - 1
