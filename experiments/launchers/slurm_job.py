"""What runs inside a job of SLURM: the process of a cell, the signals that it gets, and its requeues.

submitit starts it. submitit's own handler knows one signal only, and requeues at once, while the run still saves. This
one waits for the run's end, whatever the signal:

| signal | sent by | then |
|---|---|---|
| USR2 | SLURM, some time before the time limit (`sbatch --signal`) | saves, and the job is requeued |
| TERM | SLURM before it preempts the job, or a user | the same, if SLURM does not end the job itself |
| USR1, INT | `experiments.sweep` that was stopped, or a user | saves and ends |
"""

import itertools
import os
import platform
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from experiments.commandline.arguments import BAD_USAGE, FAILED, INTERRUPTED
from experiments.launchers import node_check, slurm_queue
from experiments.launchers.cell import INTERRUPTED_TEXT, Cell, Ended, write_ended
from experiments.launchers.cell_process import CellProcess

STOP = (signal.SIGUSR1, signal.SIGINT)
SAVE = (signal.SIGUSR2, signal.SIGTERM)
POLL_SECONDS = 0.5
REQUEUE_SECONDS = 120.0  # SLURM's controller is asked so long if it does not answer
MAX_IDLE_REQUEUES = 10  # without a new checkpoint: the job would never end
NEXT_TRY_SECONDS = 5.0


class CellJob(NamedTuple):
    """The function of a job: trains a cell and exits with the run's code."""

    cell: Cell
    token: Path  # a file that the sweep has written in --out
    out: str  # as on the command line

    def __call__(self) -> None:
        """Runs in the job, in the main thread."""
        received: list[int] = []

        def handle(number: int, _: FrameType | None) -> None:
            received.append(number)

        for handled in (*STOP, *SAVE, signal.SIGCONT):  # before it kills a job, SLURM sends SIGCONT too
            signal.signal(handled, handle)
        if not self.token.exists():
            print(node_check.not_shared(self.out, platform.node()), file=sys.stderr, flush=True)
            sys.exit(BAD_USAGE)
        job = this_job(os.environ)
        try:
            slurm_queue.rename(job.id, f"{self.cell.algo}-{self.cell.task}")
        except slurm_queue.CommandError as error:
            print(f"the job keeps its name: {error}", file=sys.stderr)
        process = CellProcess(self.cell, variables={"SQT_JOB": f"slurm {job.id}"})
        ended, forwarded = None, 0
        while ended is None:
            ended = process.wait(POLL_SECONDS)
            while ended is None and forwarded < len(received):
                number, forwarded = received[forwarded], forwarded + 1
                print(f"{signal.Signals(number).name} received", file=sys.stderr, flush=True)
                if number in (*STOP, *SAVE):
                    # The run may have got the signal from SLURM too, or not: that depends on the cluster. As SIGUSR1
                    # it counts once.
                    process.send_signal(signal.SIGUSR1)
                if number == signal.SIGTERM and not job.still_runs():
                    # SLURM may kill the run before it has saved. That it was asked to is known then.
                    write_ended(Ended(self.cell, INTERRUPTED, INTERRUPTED_TEXT, lost=True))
        if ended.code == BAD_USAGE:
            print(ended.reason, file=sys.stderr)  # the sweep reads it here if the run belongs to another process
        sys.exit(self._after(ended, set(received), job))

    def _after(self, ended: Ended, received: set[int], job: "ThisJob") -> int:
        """Requeues the job if its run was interrupted and nobody wants it to end; returns the exit code."""
        warned = bool(received & set(SAVE))
        if ended.code != INTERRUPTED and not (ended.lost and (warned or received & set(STOP))):
            return ended.code
        if received & set(STOP):
            write_ended(Ended(self.cell, INTERRUPTED, INTERRUPTED_TEXT))
            return INTERRUPTED
        if self._requeues_without_progress(job) >= MAX_IDLE_REQUEUES:
            reason = f"requeued {MAX_IDLE_REQUEUES} times without a new checkpoint; expects a longer time limit"
            write_ended(Ended(self.cell, FAILED, reason))
            return FAILED
        try:
            if job.requeued():
                return INTERRUPTED
            reason = INTERRUPTED_TEXT  # SLURM ends the job, for example at its time limit
        except slurm_queue.CommandError as error:
            reason = f"interrupted, and SLURM does not requeue it ({error}); the same command resumes it"
        write_ended(Ended(self.cell, INTERRUPTED, reason, lost=True))
        return INTERRUPTED

    def _requeues_without_progress(self, job: "ThisJob") -> int:
        """How often in a row the job has come here with the same checkpoints, before this time."""
        file = self.token.with_name(f"{job.id}.checkpoints")
        names = (path.name for path in (self.cell.path / "checkpoint").glob("step_*"))
        newest = max(names, key=lambda name: (len(name), name), default="none")
        with file.open("a+") as lines:
            lines.seek(0)
            before = lines.read().split()
            lines.write(f"{newest}\n")
        return len([*itertools.takewhile(lambda name: name == newest, reversed(before))])


class ThisJob(NamedTuple):
    """The job that this process is part of."""

    id: str  # as 12 or 12_3
    restarts: int  # how often it had been requeued when this process began

    def still_runs(self) -> bool:
        """Whether the job runs, and is not being cancelled, preempted or requeued. True if SLURM does not answer."""
        try:
            return self._is_running()
        except slurm_queue.CommandError:
            return True

    def requeued(self) -> bool:
        """Requeues the job; False if it does not run any more, or runs again already (its node was thought dead).

        Raises:
          CommandError: SLURM refuses, or does not answer for `REQUEUE_SECONDS`.
        """
        give_up = time.monotonic() + REQUEUE_SECONDS
        while True:
            try:
                if not self._is_running():
                    return False
                slurm_queue.requeue(self.id)
                print("requeued", file=sys.stderr, flush=True)
                return True
            except slurm_queue.CommandError:
                if time.monotonic() > give_up:
                    raise
            time.sleep(NEXT_TRY_SECONDS)

    def _is_running(self) -> bool:
        return slurm_queue.state_and_restarts(self.id) == ("RUNNING", self.restarts)


def this_job(variables: Mapping[str, str]) -> ThisJob:
    """The job that SLURM's variables of the environment describe."""
    # Not SLURM_JOB_ID of an element: one of them has the number of its whole array.
    array, element = variables.get("SLURM_ARRAY_JOB_ID"), variables.get("SLURM_ARRAY_TASK_ID")
    job = f"{array}_{element}" if array else variables["SLURM_JOB_ID"]
    return ThisJob(job, int(variables.get("SLURM_RESTART_COUNT", "0")))
