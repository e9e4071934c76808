"""The state of a grid's runs, read from their files: from any machine that shares the folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from experiments.commandline.arguments import DIVERGED, DONE, INTERRUPTED
from experiments.grids.finished import finished, scores
from experiments.launchers.cell import Cell, read_ended
from experiments.running import folder_lock, records, run_config
from experiments.running.progress import format_seconds


class State(NamedTuple):
    """A run's state."""

    word: str  # done, running, failed, interrupted or waiting
    text: str  # what else there is to say


class Progress(NamedTuple):
    """How far a run is, by its last evaluation."""

    env_steps: int
    steps: int  # at its end
    seconds: float  # since its start, without the time between processes

    @property
    def seconds_left(self) -> float | None:
        """At the run's mean speed so far; None before the second evaluation."""
        return self.seconds / self.env_steps * (self.steps - self.env_steps) if self.env_steps else None


def read_progress(cell: Cell) -> Progress | None:
    """How far the cell's run is; None without a table."""
    try:
        table = records.read_evaluations(cell.path / "evaluations.csv")
        steps = run_config.read(cell.path).members[0].config.train.steps
        return Progress(int(table["env_steps"][-1]), steps, float(table["wall_seconds"][-1]))
    except (OSError, ValueError, KeyError, IndexError):
        return None


def state_of(cell: Cell, job: tuple[str, str] | None = None) -> State:
    """The state of a cell's run.

    Args:
      job: what a batch system says of it, as in `job_texts` of `experiments/launchers/slurm_status.py`.
    """
    if summary := finished(cell):
        return State("done", scores(summary))
    if job and job[0] in ("waiting", "running"):
        begun = job[0] == "running" or read_progress(cell) is not None
        return State(job[0], f"{_progress(cell)}; {job[1]}" if begun else job[1])
    ended = read_ended(cell)
    holder = folder_lock.holder(cell.path)
    if holder and holder.alive and (ended is None or _is_newer(cell.path / "lock", cell.ended_file)):
        names = [holder.host, f"process {holder.process}", *([f"job {holder.job}"] if holder.job else [])]
        return State("running", f"{_progress(cell)} ({', '.join(names)})")
    if ended is None and job:
        return State(*job)
    if ended is None:
        begun = (cell.path / run_config.NAME).exists()
        return State("interrupted" if begun else "waiting", _progress(cell) if begun else "")
    if ended.code in (DONE, DIVERGED):
        return State("waiting", "")  # its folder was removed since
    if ended.lost or ended.code == INTERRUPTED:
        return State("interrupted", f"{_progress(cell)} ({ended.reason})")
    return State("failed", f"{ended.reason}; log: {cell.log}")


def status_lines(cells: Sequence[Cell], jobs: Mapping[Cell, tuple[str, str]] = MappingProxyType({})) -> list[str]:
    """A line per cell, and one that counts the states. `jobs`: as in `state_of`, of the cells that have one."""
    states = [state_of(cell, jobs.get(cell)) for cell in cells]
    width = max((len(cell.label) for cell in cells), default=0)
    lines = [
        f"{cell.label:<{width}}  {state.word:<11}  {state.text}".rstrip()
        for cell, state in zip(cells, states, strict=True)
    ]
    counts = {word: sum(state.word == word for state in states) for word in dict.fromkeys(s.word for s in states)}
    return [*lines, f"{len(cells)} runs: " + ", ".join(f"{count} {word}" for word, count in counts.items())]


def progress_text(cell: Cell) -> str | None:
    """A line about a run that is being trained; None if it is not."""
    state = state_of(cell)
    return f"{cell.label}: {state.text}" if state.word == "running" else None


def _is_newer(path: Path, other: Path) -> bool:
    try:
        return path.stat().st_mtime > other.stat().st_mtime
    except OSError:
        return False


def _progress(cell: Cell) -> str:
    progress = read_progress(cell)
    if progress is None:
        return "before its first evaluation"
    left = progress.seconds_left
    text = f"step {progress.env_steps:,} of {progress.steps:,}"
    return text if left is None else f"{text}, {format_seconds(left)} left"
