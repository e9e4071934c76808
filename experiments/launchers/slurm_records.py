"""Which job of SLURM trains a cell: a small file beside the run's folder, read by later commands."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from experiments.launchers import slurm_queue
from experiments.launchers.cell import Cell
from experiments.launchers.slurm_queue import Job
from experiments.running import files

MAX_BYTES = 100_000


class Submitted(NamedTuple):
    """A job that was submitted for a cell."""

    job: str  # its id, as 12 or 12_3
    log: Path  # what the job itself prints; the run's own output is in the cell's log


def write(cell: Cell, submitted: Submitted) -> None:
    """Records the job of a cell. Raises `OSError`."""
    with files.atomic_file(cell.job_file) as file:
        file.write((json.dumps({"slurm": submitted.job, "log": str(submitted.log)}) + "\n").encode())


def read(cell: Cell) -> Submitted | None:
    """The job that was last submitted for a cell; None if there is no file that can be read."""
    try:
        content = files.read_json(cell.job_file, MAX_BYTES)
        job, log = content["slurm"], content["log"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if not isinstance(job, str) or not isinstance(log, str) or not job.replace("_", "", 1).isdecimal():
        return None
    return Submitted(job, Path(log))


def in_queue(cells: Iterable[Cell]) -> dict[Cell, tuple[Submitted, Job]]:
    """The cells with a job that waits or runs. Asks SLURM only if a cell has ever had a job.

    Raises:
      CommandError: SLURM does not answer.
    """
    found = {cell: submitted for cell in cells if (submitted := read(cell))}
    if not found:
        return {}
    jobs = slurm_queue.jobs()
    active = {cell: (submitted, jobs[submitted.job]) for cell, submitted in found.items() if submitted.job in jobs}
    return {cell: (submitted, job) for cell, (submitted, job) in active.items() if not job.over}
