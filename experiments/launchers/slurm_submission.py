"""Submits cells to SLURM as a job array, with submitit.

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
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, suppress
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

from experiments.commandline.arguments import UsageError
from experiments.launchers.cell import Cell
from experiments.launchers.slurm_job import CellJob
from experiments.launchers.slurm_options import Options
from experiments.launchers.slurm_records import Submitted

VARIABLES_OF_A_JOB = ("SLURM_", "SLURMD_", "SRUN_", "SUBMITIT_", "SQT_JOB")
FOLDER = ".slurm"  # in --out: submitit's files, and what the jobs print


class Submission(NamedTuple):
    """How job arrays are submitted."""

    out: Path
    options: Options
    max_jobs: int | None  # elements that run at the same time; None: all


def submit_array(submission: Submission, cells: Sequence[Cell]) -> list[Submitted]:
    """Submits a job array with an element per cell; returns the jobs. Raises `UsageError` with sbatch's own error."""
    import submitit
    from submitit.core.utils import FailedJobError, FailedSubmissionError

    logging.getLogger("submitit").setLevel(logging.CRITICAL)
    folder = submission.out / FOLDER / f"{time.strftime('%Y%m%d-%H%M%S')}_{uuid.uuid4().hex[:8]}"
    created = [path for path in (folder.parent, submission.out) if not path.exists()]
    folder.mkdir(parents=True)
    token = folder.absolute() / "token"
    token.touch()
    executor = submitit.SlurmExecutor(folder)
    executor.update_parameters(**parameters(submission, cells))
    # Ctrl-C waits: the job's id must not be lost.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        functions: list[Any] = [CellJob(cell, token, str(submission.out)) for cell in cells]
        # sbatch's errors are in the exception too.
        with redirect_stderr(StringIO()), variables_of_no_job():
            jobs = executor.submit_array(functions)
    except (FailedJobError, FailedSubmissionError, OSError) as error:
        shutil.rmtree(folder, ignore_errors=True)
        for path in created:
            with suppress(OSError):  # something else is in it by now
                path.rmdir()
        text = "; ".join(line.strip() for line in str(error).splitlines() if line.strip())
        raise UsageError(f"--slurm: expects options that sbatch accepts: {text[:500]}") from None
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return [Submitted(job.job_id, job.paths.stdout) for job in jobs]


@contextmanager
def variables_of_no_job() -> Iterator[None]:
    """Hides the environment variables of the job that this process may be part of: its jobs would take them over."""
    names = [name for name in os.environ if name.startswith(VARIABLES_OF_A_JOB) and name != "SLURM_CONF"]
    hidden = {name: os.environ.pop(name) for name in names if "SLURM_JOB_ID" in names}
    try:
        yield
    finally:
        os.environ.update(hidden)


def parameters(submission: Submission, cells: Sequence[Cell]) -> dict[str, Any]:
    """What submitit's `SlurmExecutor` gets."""
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
