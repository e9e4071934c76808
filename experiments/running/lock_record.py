"""The record in the file `lock` of a run's folder: host, process and job of its holder, and a count of its beats.

One line of JSON, padded to a fixed length and written in place. Others read it while it is written, and its content
is not trusted: what is not a record is a damaged one.
"""

import json
import os
import platform
import stat
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

RECORD_BYTES = 2048
MAX_TEXT = 200  # characters of a host's or a job's name
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class Record(NamedTuple):
    """What a holder writes about itself."""

    host: str
    boot: str  # the id of the host's boot, empty where the system has none
    process: int
    job: str  # of the batch system, empty if none
    attempt: str  # at this job: differs after the engine has started the job again
    token: str  # random, one for each time that a folder is locked
    beat: int
    released: bool = False

    def __str__(self) -> str:
        return f"host {self.host}, process {self.process}" + (f", job {self.job}" if self.job else "")

    def on_host_of(self, other: "Record") -> bool:
        """Whether both are of one host. Names alone do not tell: machines made from one image can share one."""
        return (self.host, self.boot) == (other.host, other.boot)

    def succeeds(self, other: "Record | None") -> bool:
        """Whether this is a later attempt at the other's job. An engine ends one attempt before it starts the next."""
        return other is not None and self.job == other.job != "" and self.attempt != other.attempt


def new_record(host: str | None = None, variables: Mapping[str, str] = os.environ) -> Record:
    """The record of this process, with a new token.

    Args:
      host: the name of this host; None: the system's.
      variables: environment variables that name the job. SQT_JOB: set by a launcher that starts a job again only
        after its last process has ended. Else SLURM's (https://slurm.schedmd.com/sbatch.html), where processes of one
        attempt share the job and its SLURM_RESTART_COUNT.
    """
    token = uuid.uuid4().hex
    job, attempt = variables.get("SQT_JOB", ""), token
    if not job:
        job, attempt = variables.get("SLURM_JOB_ID", ""), variables.get("SLURM_RESTART_COUNT", "0")
        if array := variables.get("SLURM_ARRAY_JOB_ID", ""):
            job = f"{array}_{variables.get('SLURM_ARRAY_TASK_ID', '')}"
    name = platform.node() if host is None else host
    return Record(_plain(name), _boot_id(), os.getpid(), _plain(job), _plain(attempt), token, 0)


def _plain(text: str) -> str:
    """`text` in printable ASCII, cut to `MAX_TEXT` characters."""
    ascii_only = text.encode("ascii", "backslashreplace").decode()
    return "".join(c if c.isprintable() else "?" for c in ascii_only)[:MAX_TEXT]


def _boot_id() -> str:
    try:
        return _plain(BOOT_ID.read_text().strip())
    except OSError:  # not Linux
        return ""


def encode(record: Record) -> bytes:
    """The `RECORD_BYTES` bytes of a record."""
    line = json.dumps(record._asdict()).encode()
    return line.ljust(RECORD_BYTES - 1) + b"\n"


def decode(content: bytes) -> Record | None:
    """The record in a file's content; None if it is empty or damaged."""
    try:
        fields = json.loads(content)
        record = Record(**fields)
    except (ValueError, TypeError, RecursionError):
        return None
    texts = (record.host, record.boot, record.job, record.attempt, record.token)
    valid = (
        all(isinstance(text, str) and text.isprintable() and len(text) <= MAX_TEXT for text in texts)
        and all(type(number) is int and 0 <= number < 2**63 for number in (record.process, record.beat))
        and type(record.released) is bool
    )
    return record if valid and record.token else None


def open_file(path: Path, flags: int) -> int:
    """Opens the file `lock`; returns its descriptor. Never waits and follows no link.

    Raises:
      OSError: it cannot be opened, or is not a file.
    """
    descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise FileNotFoundError(2, "Not a file", str(path))
    return descriptor


def read(path: Path) -> tuple[bytes, float]:
    """The content of the file `lock`, and when it was written, by the clock of its file system (s since 1970).

    Opens the file each time, so that what another host has written is seen (close-to-open consistency: man 5 nfs).

    Raises:
      OSError: it cannot be read.
    """
    descriptor = open_file(path, os.O_RDONLY)
    try:
        return os.pread(descriptor, RECORD_BYTES + 1, 0), os.fstat(descriptor).st_mtime
    finally:
        os.close(descriptor)
