"""The grids, their cells, and the names of the runs."""

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.commandline.arguments import UsageError
from experiments.evidence.published import PAPERS_TASKS
from experiments.running import run_config
from sqt_jax import envs
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.suggestions import expects_one_of

PAPERS_BASELINES = ("td3", "sac", "td7")
MAX_NAME = 200
# Flags of experiments.run that the grid sets, differently for each cell.
CELL_FLAGS = ("algo", "env", "out", "name", "resume", "overwrite")


class Grid(NamedTuple):
    """Algorithms times tasks."""

    algos: tuple[str, ...]
    tasks: tuple[str, ...] = PAPERS_TASKS
    flags: tuple[str, ...] = ()  # further flags of each run


WITH_SQT = tuple(name for baseline in PAPERS_BASELINES for name in (baseline, f"{baseline}_sqt"))
GRIDS = {
    "table2": Grid(WITH_SQT),
    "table3": Grid(WITH_SQT),  # the same runs; the table shows another statistic
    "table4": Grid(tuple(f"{baseline}{suffix}" for baseline in PAPERS_BASELINES for suffix in ("_sqt", "_sqt_tuple"))),
    "all": Grid(tuple(f"{baseline}{suffix}" for baseline in PAPERS_BASELINES for suffix in ("", "_sqt", "_sqt_tuple"))),
    "alpha": Grid(("td3_sqt",), ("cheetah",), ("--penalty_coef=0,0.1,0.25,0.5,1",)),
}


class GridCell(NamedTuple):
    """One run of a grid: an algorithm on a task, with all seeds."""

    task: str
    algo: str
    path: Path
    command: tuple[str, ...]  # arguments of experiments.run


def make_cells(
    name: str | None, algos: Sequence[str], tasks: Sequence[str], out: Path, flags: Sequence[str]
) -> list[GridCell]:
    """The cells of the grid `name`, checked.

    Args:
      algos, tasks: instead of the grid's own, if not empty.
      flags: of every run, as `--flag=value`.

    Raises:
      UsageError: a name is unknown, or a flag is one of `CELL_FLAGS`.
    """
    if name is None:
        raise UsageError(f"--grid: expects one of {', '.join(GRIDS)}")
    if name not in GRIDS:
        raise UsageError(f"--grid: {expects_one_of(name, GRIDS)}")
    for algo in algos:
        if algo not in ALGORITHMS:
            raise UsageError(f"--algos: {expects_one_of(algo, ALGORITHMS)}")
    try:
        tasks = [envs.resolve(task) for task in tasks]
    except ValueError as error:
        raise UsageError(f"--tasks: {error}") from None
    for word in flags:
        if not word.startswith("--") or word.lstrip("-").split("=")[0] in CELL_FLAGS:
            raise UsageError(
                f"{word}: expects flags of experiments.run in the form --flag=value, except --{', --'.join(CELL_FLAGS)}"
            )
    return cells_of(GRIDS[name], algos, tasks, out, flags)


def cells_of(grid: Grid, algos: Sequence[str], tasks: Sequence[str], out: Path, flags: Sequence[str]) -> list[GridCell]:
    """The cells of a grid, task by task; arguments as in `make_cells`."""
    cells = []
    for task in tasks or grid.tasks:
        for algo in algos or grid.algos:
            run_flags = (*grid.flags, *flags)
            name = run_name(run_flags)
            command = (f"--algo={algo}", f"--env={task}", f"--out={out}", f"--name={name}", "--resume", *run_flags)
            cells.append(
                GridCell(task=task, algo=algo, path=out / run_config.task_folder(task) / algo / name, command=command)
            )
    return cells


def run_name(flags: Sequence[str]) -> str:
    """A run's name, made of its flags, so that grids share their runs. A long name ends in a hash of the flags."""
    name = "_".join(word.lstrip("-").replace("/", "-") for word in sorted(flags)) or "default"
    if len(name) <= MAX_NAME:
        return name
    digest = hashlib.sha256(os.fsencode("\n".join(sorted(flags))))
    return f"{name[: MAX_NAME - 13]}_{digest.hexdigest()[:12]}"


def finished(cell: GridCell) -> dict[str, Any] | None:
    """The content of summary.json if the cell's run has ended, else None."""
    try:
        summary = json.loads((cell.path / "summary.json").read_text())
        return summary if summary["status"] in ("done", "diverged") else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def needs_training(cell: GridCell) -> bool:
    """Whether a cell has to be started. One with --config always is: the run itself compares the file's settings."""
    return any(word.startswith("--config=") for word in cell.command) or not finished(cell)
