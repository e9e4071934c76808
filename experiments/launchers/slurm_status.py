"""What SLURM knows of the cells of a grid, for `sweep --status`."""

from collections.abc import Sequence
from pathlib import Path

from experiments.commandline.arguments import BAD_USAGE
from experiments.launchers import slurm_queue, slurm_records
from experiments.launchers.cell import Cell, read_ended
from experiments.launchers.slurm import outcome

WAITING = ("PENDING", "REQUEUE_HOLD", "SPECIAL_EXIT")


def job_texts(cells: Sequence[Cell], out: Path) -> dict[Cell, tuple[str, str]]:
    """A word and a text for cells that a job was submitted for: `waiting` or `running`, and the job's id.

    For a cell whose job has ended without a word of the run: `failed` or `interrupted`, and why. Empty if SLURM cannot
    be asked here.
    """
    found = {cell: submitted for cell in cells if (submitted := slurm_records.read(cell))}
    try:
        queue = slurm_queue.jobs() if found else {}
    except slurm_queue.CommandError:
        return {}
    texts = {}
    for cell, submitted in found.items():
        job = queue.get(submitted.job)
        if job and not job.over:
            detail = job.state.lower() if job.reason == "None" else job.reason
            text = f"job {submitted.job}" + ("" if job.state == "RUNNING" else f" ({detail})")
            texts[cell] = ("waiting" if job.state in WAITING else "running", text)
        elif read_ended(cell) is None and (ended := outcome(cell, job, submitted, out, waited=True)):
            texts[cell] = ("failed" if ended.code == BAD_USAGE else "interrupted", ended.reason)
    return texts
