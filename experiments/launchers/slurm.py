"""`--launcher=slurm`: cells as elements of a job array of SLURM. How their end is known, and how they are stopped."""

import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from experiments.commandline.arguments import BAD_USAGE, FAILED, INTERRUPTED, UsageError, printable
from experiments.launchers import slurm_options, slurm_queue, slurm_records
from experiments.launchers.cell import Cell, Ended, read_ended
from experiments.launchers.node_check import not_shared
from experiments.launchers.slurm_queue import CommandError, Job
from experiments.launchers.slurm_records import Submitted
from experiments.launchers.slurm_submission import Submission, submit_array

POLL_SECONDS = 5.0  # between two questions to SLURM, one for all jobs
SHARING_SECONDS = 15.0  # a shared folder may show a new file that much later
STOP_SIGNAL = "USR1"  # a job that gets it saves and ends
TAIL_BYTES = 2_000
REFUSALS = ("--out=", "--launcher=", "--name=", "--resume=")  # how lines begin in which a job or its run refuses


class SlurmLauncher:
    """Submits cells as a job array; those whose job of an earlier command still waits or runs are not submitted again.

    Args:
      out: as on the command line.
      array: submits cells and returns their jobs. Raises `UsageError`.
    """

    def __init__(
        self,
        out: Path,
        array: Callable[[Sequence[Cell]], Sequence[Submitted]],
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self.already_queued: dict[Cell, Submitted] = {}
        self._out, self._array, self._clock, self._sleep = out, array, clock, sleep
        self._submitted = False
        self._jobs: dict[Cell, Submitted] = {}
        self._refused: list[Ended] = []
        self._over: dict[Cell, tuple[float, Job | None]] = {}  # since when, and what SLURM said then
        self._next_poll = 0.0
        self._cancels = 0

    def submit(self, cells: Sequence[Cell]) -> None:
        """As `Launcher.submit`. After the first call, cells that cannot be submitted are lost; the others go on."""
        try:
            self._submit(cells)
        except (UsageError, CommandError, OSError) as error:
            if not self._submitted:
                if isinstance(error, OSError):
                    raise
                raise UsageError(f"{'' if isinstance(error, UsageError) else '--launcher=slurm: '}{error}") from None
            self._refused += [Ended(cell, FAILED, str(error), lost=True) for cell in cells if cell not in self._jobs]
        self._submitted = True

    def _submit(self, cells: Sequence[Cell]) -> None:
        queued = {cell: submitted for cell, (submitted, _) in slurm_records.in_queue(cells).items()}
        self.already_queued |= queued
        self._jobs |= queued
        new = [cell for cell in cells if cell not in queued]
        for cell in new:
            cell.ended_file.unlink(missing_ok=True)  # what it says is of an earlier job
        if new:
            jobs = dict(zip(new, self._array(new), strict=True))
            self._jobs |= jobs  # all before a file is written: they are ended if that fails
            for cell, submitted in jobs.items():
                cell.path.parent.mkdir(parents=True, exist_ok=True)
                slurm_records.write(cell, submitted)

    def ended(self) -> list[Ended]:
        """As `Launcher.ended`."""
        found, self._refused = self._refused, []
        if self._cancels > 1:
            found += [Ended(cell, INTERRUPTED, "ended at once") for cell in self._jobs]
            self._jobs.clear()
        if found:
            return found
        if (left := self._next_poll - self._clock()) > 0:
            self._sleep(min(left, 1.0))
            return []
        self._next_poll = self._clock() + POLL_SECONDS
        try:
            queue = slurm_queue.jobs()
        except CommandError:
            return []  # the controller restarts, for example; the jobs go on
        if self._cancels:
            self._stop(queue)
        found = [ended for cell in self._jobs if (ended := self._ended(cell, queue.get(self._jobs[cell].job)))]
        for ended in found:
            del self._jobs[ended.cell], self._over[ended.cell]
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

    def _ended(self, cell: Cell, job: Job | None) -> Ended | None:
        """How a cell has ended; None if its job is not over, or its files may not be visible yet."""
        if job and not job.over:
            self._over.pop(cell, None)
            return None
        since, job = self._over.setdefault(cell, (self._clock(), job))  # SLURM may forget it while files are awaited
        waited = self._cancels > 0 or self._clock() - since >= SHARING_SECONDS
        return outcome(cell, job, self._jobs[cell], self._out, waited)

    def _stop(self, queue: dict[str, Job]) -> None:
        """Drops jobs that wait, and asks those that run to save and end.

        At each poll again: a job that has just started has no program yet that could get the signal, and one that is
        being requeued waits only afterwards.
        """
        ours = {submitted.job for submitted in self._jobs.values()} & set(queue)
        if waiting := sorted(job for job in ours if queue[job].state == "PENDING"):
            with suppress(CommandError):
                slurm_queue.cancel(waiting)
        for job in sorted(job for job in ours if queue[job].state == "RUNNING"):
            with suppress(CommandError):
                slurm_queue.send(STOP_SIGNAL, [job])

    def _kill(self) -> None:
        if ids := [submitted.job for submitted in self._jobs.values()]:
            for end in (slurm_queue.kill, slurm_queue.cancel):
                with suppress(CommandError):
                    end(ids)


def outcome(cell: Cell, job: Job | None, submitted: Submitted, out: Path, waited: bool) -> Ended | None:
    """How a cell has ended whose job is over.

    Args:
      job: as SLURM remembers it; None: it has forgotten it.
      waited: whether files that do not exist will not appear later.

    Returns:
      None: wait for the files.
    """
    state = job.state if job else "forgotten by SLURM"
    if ended := read_ended(cell):
        # A lost run has been ended by SLURM. If a user cancelled it, it is not started again.
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
        return Ended(cell, BAD_USAGE, f"{not_shared(str(out), node)} (job {submitted.job}: {state})")
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
    options = slurm_options.parse(slurm or "", slurm_setup)
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
