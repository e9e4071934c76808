"""The grids, their cells, and the names of the runs."""

import hashlib
import os
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

from experiments.commandline import flags
from experiments.commandline.arguments import UsageError
from experiments.evidence.published import PAPERS_TASKS
from experiments.grids.check_cells import check_cells, check_once, own_environment
from experiments.grids.finished import finished
from experiments.grids.own_grid import CELL_FLAGS, OWN_GRID, check_not_set, parse_variants
from experiments.launchers.cell import Cell
from experiments.running import run_config
from sqt_jax import envs
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.envs.factories import is_factory
from sqt_jax.suggestions import expects_one_of

PAPERS_BASELINES = ("td3", "sac", "td7")
MAX_NAME = 200
MAX_CELLS = 10_000


class Grid(NamedTuple):
    """Algorithms times tasks, and times variants of further flags."""

    algos: tuple[str, ...]
    tasks: tuple[str, ...] = PAPERS_TASKS
    variants: tuple[tuple[str, ...], ...] = ((),)  # the flags of each variant, as `--flag=value`


WITH_SQT = tuple(name for baseline in PAPERS_BASELINES for name in (baseline, f"{baseline}_sqt"))
GRIDS = {
    "table2": Grid(WITH_SQT),
    "table3": Grid(WITH_SQT),  # the same runs; the table shows another statistic
    "table4": Grid(tuple(f"{baseline}{suffix}" for baseline in PAPERS_BASELINES for suffix in ("_sqt", "_sqt_tuple"))),
    "all": Grid(tuple(f"{baseline}{suffix}" for baseline in PAPERS_BASELINES for suffix in ("", "_sqt", "_sqt_tuple"))),
    "alpha": Grid(("td3_sqt",), ("cheetah",), (("--penalty_coef=0,0.1,0.25,0.5,1",),)),
}


def make_cells(
    name: str | None,
    algos: Sequence[str],
    tasks: Sequence[str],
    out: Path,
    run_flags: Sequence[str],
    seeds_per_cell: int | None = None,
) -> list[Cell]:
    """The cells of a grid, checked.

    Args:
      name: of `GRIDS`, or settings of a grid of one's own; None: --algos and --tasks alone.
      algos, tasks: instead of the grid's own, if not empty.
      run_flags: of every run, as `--flag=value`.
      seeds_per_cell: splits the seeds of each run over cells of at most so many; None: one cell has all.

    Raises:
      UsageError: a name is unknown; a flag is invalid, of no effect with an algorithm, set twice or one of
        `CELL_FLAGS`; or a run comes twice.
    """
    grid = _find_grid(name, algos, tasks)
    for algo in algos:
        if algo not in ALGORITHMS:
            raise UsageError(f"--algos: {expects_one_of(algo, ALGORITHMS)}")
    try:
        resolved = [task if is_factory(task) else envs.resolve(task) for task in tasks]
    except ValueError as error:
        raise UsageError(f"--tasks: {error}") from None
    check_once("--algos", algos, algos)
    check_once("--tasks", tasks, resolved)
    check_run_flags(run_flags, CELL_FLAGS)
    check_not_set(grid.variants, run_flags, name or "")
    cells = cells_of(grid, algos, resolved, out, run_flags, seeds_per_cell)
    check_cells(cells)
    return cells


def check_run_flags(run_flags: Sequence[str], own: Sequence[str]) -> None:
    """Raises `UsageError` if a word is not a flag with its value, or is one of `own`, which the command sets."""
    for word in run_flags:
        if not word.startswith("--") or word.lstrip("-").split("=")[0] in own:
            raise UsageError(
                f"{word}: expects flags of experiments.run in the form --flag=value, except --{', --'.join(own)}"
            )


def _find_grid(name: str | None, algos: Sequence[str], tasks: Sequence[str]) -> Grid:
    named = f"one of {', '.join(GRIDS)}, or {OWN_GRID}"
    if name in GRIDS:
        return GRIDS[name]
    if name is not None and "=" not in name:
        raise UsageError(f"--grid: {expects_one_of(name, GRIDS)}, or {OWN_GRID}")
    if not algos or not tasks:
        raise UsageError(f"--grid: expects {named}")
    return Grid(tuple(algos), tuple(tasks), parse_variants(name or ""))


def cells_of(
    grid: Grid,
    algos: Sequence[str],
    tasks: Sequence[str],
    out: Path,
    run_flags: Sequence[str],
    seeds_per_cell: int | None = None,
) -> list[Cell]:
    """The cells of a grid, task by task; arguments as in `make_cells`. Raises `UsageError` if there are too many."""
    parts = [part for variant in grid.variants for part in split_seeds((*variant, *run_flags), seeds_per_cell)]
    common = set(parts[0]).intersection(*parts)
    cells = []
    for task, own_flags, algo in product(tasks or grid.tasks, parts, algos or grid.algos):
        name = run_name(own_flags)
        command = (f"--algo={algo}", f"--env={task}", f"--out={out}", f"--name={name}", "--resume", *own_flags)
        path = out / _task_folder(task, own_flags) / algo / name
        detail = " ".join(word.lstrip("-") for word in own_flags if word not in common)
        cells.append(Cell(task=task, algo=algo, path=path, command=command, detail=detail))
    if len(cells) > MAX_CELLS:
        raise UsageError(f"--grid: expects at most {MAX_CELLS:,} runs, not {len(cells):,}")
    return cells


def _task_folder(task: str, run_flags: Sequence[str]) -> str:
    """The name of the folder of a task's runs. An environment of one's own is made to know its name."""
    if not is_factory(task):
        return run_config.task_folder(task)
    parsed = flags.parse(["run", "--algo=td3", f"--env={task}", *run_flags])
    assert parsed
    env = own_environment(task, parsed)
    assert env
    return run_config.task_folder(env.name)


def split_seeds(run_flags: Sequence[str], per_cell: int | None) -> list[tuple[str, ...]]:
    """The flags of each part of a run whose seeds are split over cells of at most `per_cell`. Raises `UsageError`."""
    if per_cell is None:
        return [tuple(run_flags)]
    parsed = flags.parse(["run", "--algo=td3", "--env=cheetah", *run_flags])  # --config may have seeds too
    assert parsed and parsed.seeds
    others = [word for word in run_flags if not word.startswith("--seeds=")]
    groups = [parsed.seeds[begin : begin + per_cell] for begin in range(0, len(parsed.seeds), per_cell)]
    return [(*others, f"--seeds={','.join(map(str, group))}") for group in groups]


def run_name(run_flags: Sequence[str]) -> str:
    """A run's name, made of its flags, so that grids share their runs. A long name ends in a hash of the flags.

    --wandb is left out: it may be added to runs that have begun.
    """
    run_flags = [word for word in run_flags if word.lstrip("-").split("=")[0] not in ("wandb", "nowandb")]
    name = "_".join(word.lstrip("-").replace("/", "-") for word in sorted(run_flags)) or "default"
    if len(name) <= MAX_NAME:
        return name
    digest = hashlib.sha256(os.fsencode("\n".join(sorted(run_flags))))
    return f"{name[: MAX_NAME - 13]}_{digest.hexdigest()[:12]}"


def needs_training(cell: Cell) -> bool:
    """Whether a cell has to be started. One with --config always is: the run itself compares the file's settings."""
    return any(word.startswith("--config=") for word in cell.command) or not finished(cell)
