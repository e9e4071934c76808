"""`--launcher=slurm`: cells as elements of a job array of SLURM, submitted with submitit.

https://slurm.schedmd.com/job_array.html, https://github.com/facebookincubator/submitit
"""

import logging
import os
import shlex
import shutil
import signal
import sys
import time
import uuid
from collections.abc import Sequence
from contextlib import redirect_stderr, suppress
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

from experiments.commandline.arguments import BAD_USAGE, FAILED, INTERRUPTED, UsageError, printable
from experiments.launchers import slurm_queue, slurm_records
from experiments.launchers.cell import Cell, Ended, read_ended
from experiments.launchers.slurm_job import CellJob
from experiments.launchers.slurm_options import Options
from experiments.launchers.slurm_options import parse as parse_options
from experiments.launchers.slurm_records import Submitted

FOLDER = ".slurm"  # in --out: submitit's files, and what the jobs print
POLL_SECONDS = 5.0  # between two questions to SLURM, one for all jobs
SHARING_SECONDS = 15.0  # a shared folder may show a new file that much later
STOP_SIGNAL = "USR1"  # a job that gets it saves and ends
TAIL_BYTES = 2_000
REFUSALS = ("--out=", "--launcher=")  # how lines begin in which a job refuses to train


class Submission(NamedTuple):
    """How job arrays are submitted."""

    out: Path
    options: Options
    max_jobs: int | None  # elements that run at the same time; None: all


class SlurmLauncher:
    """Submits cells as a job array; those whose job of an earlier command still waits or runs are not submitted again.

    Args:
      array: submits cells and returns their jobs. Raises `UsageError`.
    """

    def __init__(self, out: Path, array: Any, clock: Any = time.monotonic, sleep: Any = time.sleep):
        self.already_queued: dict[Cell, Submitted] = {}
        self._out, self._array, self._clock, self._sleep = out, array, clock, sleep
        self._jobs: dict[Cell, Submitted] = {}
        self._over: dict[Cell, tuple[float, slurm_queue.Job | None]] = {}  # since when, and what SLURM said then
        self._next_poll = 0.0
        self._cancels = 0

    def submit(self, cells: Sequence[Cell]) -> None:
        """As `Launcher.submit`."""
        try:
            queued = {cell: submitted for cell, (submitted, _) in slurm_records.in_queue(cells).items()}
        except slurm_queue.CommandError as error:
            raise UsageError(f"--launcher=slurm: {error}") from None
        self.already_queued |= queued
        self._jobs |= queued
        new = [cell for cell in cells if cell not in queued]
        for cell in new:
            cell.path.parent.mkdir(parents=True, exist_ok=True)
            cell.ended_file.unlink(missing_ok=True)  # what it says is of an earlier job
        if not new:
            return
        for cell, submitted in zip(new, self._array(new), strict=True):
            self._jobs[cell] = submitted
            slurm_records.write(cell, submitted)

    def ended(self) -> list[Ended]:
        """As `Launcher.ended`."""
        if self._cancels > 1:
            found = [Ended(cell, INTERRUPTED, "ended at once") for cell in self._jobs]
            self._jobs.clear()
            return found
        if (left := self._next_poll - self._clock()) > 0:
            self._sleep(min(left, 1.0))
            return []
        self._next_poll = self._clock() + POLL_SECONDS
        try:
            queue = slurm_queue.jobs()
        except slurm_queue.CommandError:
            return []  # the controller restarts, for example; the jobs go on
        if self._cancels:
            self._stop(queue)
        found = [ended for cell in [*self._jobs] if (ended := self._ended(cell, queue.get(self._jobs[cell].job)))]
        for ended in found:
            del self._jobs[ended.cell]
            self._over.pop(ended.cell, None)
        return found

    def cancel(self) -> None:
        """As `Launcher.cancel`."""
        self._cancels += 1
        self._next_poll = 0.0
        if self._cancels > 1:
            self._kill()

    def __enter__(self) -> "SlurmLauncher":
        return self

    def __exit__(self, *error: object) -> None:
        self._kill()

    def _ended(self, cell: Cell, job: slurm_queue.Job | None) -> Ended | None:
        """How a cell has ended; None if its job is not over, or its files may not be visible yet."""
        if job and not job.over:
            self._over.pop(cell, None)
            return None
        since, job = self._over.setdefault(cell, (self._clock(), job))  # SLURM may forget it while files are awaited
        waited = self._cancels > 0 or self._clock() - since >= SHARING_SECONDS
        return outcome(cell, job, self._jobs[cell], self._out, waited)

    def _stop(self, queue: dict[str, slurm_queue.Job]) -> None:
        """Drops jobs that wait, and asks those that run to save and end.

        At each poll again: a job that has just started has no program yet that could get the signal, and one that is
        being requeued waits only afterwards.
        """
        ours = {submitted.job for submitted in self._jobs.values()} & set(queue)
        waiting = sorted(job for job in ours if queue[job].state == "PENDING")
        running = sorted(job for job in ours if queue[job].state == "RUNNING")
        if waiting:
            with suppress(slurm_queue.CommandError):
                slurm_queue.cancel(waiting)
        for job in running:
            with suppress(slurm_queue.CommandError):
                slurm_queue.send(STOP_SIGNAL, [job])

    def _kill(self) -> None:
        ids = [submitted.job for submitted in self._jobs.values()]
        if not ids:
            return
        for end in (slurm_queue.kill, slurm_queue.cancel):
            with suppress(slurm_queue.CommandError):
                end(ids)


def outcome(cell: Cell, job: slurm_queue.Job | None, submitted: Submitted, out: Path, waited: bool) -> Ended | None:
    """How a cell has ended whose job is over.

    Args:
      job: as SLURM remembers it; None: it has forgotten it.
      waited: whether files that do not exist will not appear later.

    Returns:
      None: wait for the files.
    """
    state = job.state if job else "gone"
    if ended := read_ended(cell):
        # The job has saved, and SLURM has ended it. If a user cancelled it, it stays so.
        return ended._replace(lost=ended.lost and not (ended.code == INTERRUPTED and state == "CANCELLED"))
    lines = _last_lines(submitted.log)
    if state == "CANCELLED" and lines is None:
        return Ended(cell, INTERRUPTED, f"job {submitted.job} was cancelled before it started")
    if refusal := next((line for line in lines or () if line.startswith(REFUSALS)), None):
        return Ended(cell, BAD_USAGE, refusal)
    if not waited:
        return None
    if lines is None:
        node = job.node if job and job.node != "n/a" else "the job's machine"
        text = f"--out={out}: expects a folder that all machines share; {node} does not see it"
        return Ended(cell, BAD_USAGE, f"{text} (job {submitted.job}: {state})")
    last = lines[-1] if lines else "it printed nothing"
    return Ended(cell, FAILED, f"job {submitted.job} was lost ({state}): {last}", lost=True)


def _last_lines(path: Path) -> list[str] | None:
    """The last lines of a job's log; None if there is no log."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - TAIL_BYTES))
            lines = file.read().decode(errors="replace").split("\n")
    except OSError:
        return None
    return [printable(line.strip())[:500] for line in lines if line.strip()]


def make(out: Path, max_jobs: int | None, slurm: str | None, slurm_setup: str | None) -> SlurmLauncher:
    """The launcher of `--launcher=slurm`. Raises `UsageError`: an invalid option, or no submitit or SLURM here."""
    options = parse_options(slurm or "", slurm_setup)
    if any(character in str(out.absolute()) for character in "%\\"):
        raise UsageError(f"--out={out}: expects a path without % and \\, which SLURM replaces")
    try:
        import submitit  # noqa: F401
    except ImportError:
        raise UsageError("--launcher=slurm: expects the package submitit; pip install 'sqt_jax[slurm]'") from None
    for program in ("sbatch", "srun", "squeue", "scancel", "scontrol"):
        if shutil.which(program) is None:
            raise UsageError(f"--launcher=slurm: expects SLURM's commands on this machine; there is no {program}")
    submission = Submission(out, options, max_jobs)
    return SlurmLauncher(out, lambda cells: submit_array(submission, cells))


def submit_array(submission: Submission, cells: Sequence[Cell]) -> list[Submitted]:
    """Submits a job array with an element per cell; returns the jobs. Raises `UsageError` with sbatch's own error."""
    import submitit
    from submitit.core.utils import FailedJobError, FailedSubmissionError

    logging.getLogger("submitit").setLevel(logging.CRITICAL)
    folder = submission.out / FOLDER / f"{time.strftime('%Y%m%d-%H%M%S')}_{uuid.uuid4().hex[:8]}"
    folder.mkdir(parents=True)
    token = folder.absolute() / "token"
    token.touch()
    executor = submitit.SlurmExecutor(folder)
    executor.update_parameters(**parameters(submission, cells))
    # Ctrl-C waits: the job's id must not be lost.
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        functions: list[Any] = [CellJob(cell, token, str(submission.out)) for cell in cells]
        with redirect_stderr(StringIO()):  # sbatch's errors, which are in the exception too
            jobs = executor.submit_array(functions)
    except (FailedJobError, FailedSubmissionError, OSError) as error:
        shutil.rmtree(folder, ignore_errors=True)
        text = "; ".join(line.strip() for line in str(error).splitlines() if line.strip())
        raise UsageError(f"--slurm: expects options that sbatch accepts: {text[:500]}") from None
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    return [Submitted(job.job_id, job.paths.stdout) for job in jobs]


def parameters(submission: Submission, cells: Sequence[Cell]) -> dict[str, Any]:
    """What submitit's `SlurmExecutor` is told."""
    options = submission.options
    return {
        "job_name": f"{cells[0].algo}-{cells[0].task}" if len(cells) == 1 else "sqt_jax",
        "time": None,  # SLURM's own default unless given: submitit's is five minutes
        "wckey": None,
        "signal_delay_s": options.save_seconds,
        "array_parallelism": submission.max_jobs or len(cells),
        "stderr_to_stdout": True,
        "setup": [*options.setup, *checks(os.getcwd(), sys.executable)],
        "additional_parameters": {"requeue": True, **options.sbatch},
    }


def checks(folder: str, python: str) -> list[str]:
    """Shell lines of a job that end it in one line if its machine has not the code or Python."""
    needs = [
        (f"cd {shlex.quote(folder)}", f"the folder {folder}"),
        (
            f"{shlex.quote(python)} -c 'import submitit, experiments.launchers.slurm_job'",
            f"{python} with sqt_jax[slurm]",
        ),
    ]
    lines = [
        f"{command} || {{ echo {shlex.quote(f'--launcher=slurm: expects {what} on all machines;')}"
        ' "${SLURMD_NODENAME:-$(hostname)} does not have it" >&2; exit 2; }'
        for command, what in needs
    ]
    # Since version 22.05 srun does not take this number from the job.
    return [*lines, 'if [ -n "$SLURM_CPUS_PER_TASK" ]; then export SRUN_CPUS_PER_TASK="$SLURM_CPUS_PER_TASK"; fi']
