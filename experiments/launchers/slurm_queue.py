"""SLURM's commands: what is in its queue, and how jobs are signalled, cancelled and requeued.

None of them needs accounting (`sacct`). SLURM's manual: https://slurm.schedmd.com/squeue.html, scancel.html,
scontrol.html.
"""

import os
import re
import subprocess
from collections.abc import Sequence
from typing import NamedTuple

from sqt_jax.one_line import one_line

COMMAND_SECONDS = 60.0
# States in which a job will not run again. All others, such as COMPLETING, may lead back into the queue.
OVER = frozenset(
    ("BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL")
    + ("OUT_OF_MEMORY", "PREEMPTED", "REVOKED", "TIMEOUT")
)
CHUNK = 500  # jobs in one command line


class CommandError(Exception):
    """A command of SLURM failed. The text is one line: its own message."""


class Job(NamedTuple):
    """A job, or an element of a job array, in SLURM's queue."""

    state: str  # PENDING, RUNNING, ...
    reason: str  # why it waits, as in Resources
    node: str  # its first node, n/a before it starts

    @property
    def over(self) -> bool:
        """Whether it has ended and will not run again."""
        return self.state in OVER


def jobs() -> dict[str, Job]:
    """This user's jobs by id, as 12 or 12_3. Ended ones stay for some minutes (MinJobAge). Raises `CommandError`."""
    text = _call("squeue", "--noheader", "--array", "--states=all", f"--user={os.getuid()}", "--format=%i|%T|%r|%B")
    return read_jobs(text)


def read_jobs(text: str) -> dict[str, Job]:
    """The jobs in lines of the form `ID|STATE|REASON|NODE`."""
    fields = (line.strip().split("|") for line in text.splitlines())
    return {job: Job(state, reason, node) for job, state, reason, node in (f for f in fields if len(f) == 4)}


def state_and_restarts(job: str) -> tuple[str, int]:
    """A job's state, and how often it has been requeued. Raises `CommandError`."""
    text = _call("scontrol", "--oneliner", "show", "job", job)
    state, restarts = re.search(r"\bJobState=(\w+)", text), re.search(r"\bRestarts=(\d+)", text)
    if not state or not restarts:
        raise CommandError(f"scontrol: {text.strip()[:200]}")
    return state[1], int(restarts[1])


def requeue(job: str) -> None:
    """Ends a job and puts it back into the queue. Raises `CommandError`."""
    _call("scontrol", "requeue", job)


def rename(job: str, name: str) -> None:
    """Gives a job another name. Raises `CommandError`."""
    _call("scontrol", "update", f"JobId={job}", f"JobName={name}")


def send(signal_name: str, ids: Sequence[str]) -> None:
    """Sends a signal to the first step of running jobs. Raises `CommandError`, also if one has no step (any more).

    To the step, not to the job: for an element of an array of which others still wait, SLURM 22.05 delivers the signal,
    answers that it has not, and scancel repeats it for more than a minute.
    """
    for begin in range(0, len(ids), CHUNK):
        _call("scancel", f"--signal={signal_name}", *(f"{job}.0" for job in ids[begin : begin + CHUNK]))


def cancel(ids: Sequence[str]) -> None:
    """Cancels jobs: running ones get SIGTERM, and SIGKILL after some time (KillWait). Raises `CommandError`."""
    for begin in range(0, len(ids), CHUNK):
        _call("scancel", *ids[begin : begin + CHUNK])


def kill(ids: Sequence[str]) -> None:
    """Ends jobs at once. Raises `CommandError`."""
    for begin in range(0, len(ids), CHUNK):
        _call("scancel", "--full", "--signal=KILL", *ids[begin : begin + CHUNK])


def _call(*command: str) -> str:
    """What a command prints. A session of its own: Ctrl-C must not end it half-way."""
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=COMMAND_SECONDS,
            start_new_session=True,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CommandError(f"{command[0]}: {one_line(error)}") from None
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise CommandError("; ".join(line.strip() for line in lines)[:500])
    return done.stdout
