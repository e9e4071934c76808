"""The grids, their cells, and the names of the runs."""

import hashlib
import json
import os
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from experiments.commandline import flags
from experiments.commandline.arguments import UsageError
from experiments.evidence.published import PAPERS_TASKS
from experiments.launchers.cell import Cell
from experiments.running import run_config
from sqt_jax import envs
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.envs import env_args
from sqt_jax.envs.factories import is_factory, make_from
from sqt_jax.suggestions import expects_one_of

PAPERS_BASELINES = ("td3", "sac", "td7")
MAX_NAME = 200
MAX_CELLS = 10_000
# Flags of experiments.run that the grid sets, differently for each cell.
CELL_FLAGS = ("algo", "env", "out", "name", "resume", "overwrite")


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
OWN_GRID = "settings like 'penalty_coef=0.1,0.5;ensemble_size=2,5' with --algos and --tasks"


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
      UsageError: a name is unknown, or a flag is invalid or one of `CELL_FLAGS`.
    """
    grid = _find_grid(name, algos, tasks)
    for algo in algos:
        if algo not in ALGORITHMS:
            raise UsageError(f"--algos: {expects_one_of(algo, ALGORITHMS)}")
    try:
        tasks = [task if is_factory(task) else envs.resolve(task) for task in tasks]
    except ValueError as error:
        raise UsageError(f"--tasks: {error}") from None
    check_run_flags(run_flags, CELL_FLAGS)
    cells = cells_of(grid, algos, tasks, out, run_flags, seeds_per_cell)
    for cell in cells:  # before any of them starts
        flags.parse(["run", *cell.command])
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


def parse_variants(text: str) -> tuple[tuple[str, ...], ...]:
    """The variants of a grid like `penalty_coef=0.1,0.5;hidden=64,64|256,256`: all combinations of the values.

    Values are separated by commas; by `|` if there is one, for values with commas. Raises `UsageError`.
    """
    choices = []
    for part in filter(None, (part.strip() for part in text.split(";"))):
        setting, equals, values = part.partition("=")
        found = [value.strip() for value in values.split("|" if "|" in values else ",")]
        if not equals or not setting.isidentifier() or not all(found):
            raise UsageError(f"--grid={text}: expects {OWN_GRID}, not {part!r}")
        if setting in (*CELL_FLAGS, "config"):
            raise UsageError(f"--grid={text}: expects settings of a run, not {setting}")
        if len(set(found)) < len(found):
            raise UsageError(f"--grid={text}: expects each value of {setting} once")
        choices.append([f"--{setting}={value}" for value in found])
    names = [group[0].partition("=")[0] for group in choices]
    if len(set(names)) < len(names):
        raise UsageError(f"--grid={text}: expects each setting once")
    return tuple(product(*choices))


def cells_of(
    grid: Grid,
    algos: Sequence[str],
    tasks: Sequence[str],
    out: Path,
    run_flags: Sequence[str],
    seeds_per_cell: int | None = None,
) -> list[Cell]:
    """The cells of a grid, task by task; arguments as in `make_cells`. Raises `UsageError` if there are too many."""
    cells = []
    for task, variant, algo in product(tasks or grid.tasks, grid.variants, algos or grid.algos):
        for own_flags in split_seeds((*variant, *run_flags), seeds_per_cell):
            name = run_name(own_flags)
            command = (f"--algo={algo}", f"--env={task}", f"--out={out}", f"--name={name}", "--resume", *own_flags)
            path = out / _task_folder(task, own_flags) / algo / name
            cells.append(Cell(task=task, algo=algo, path=path, command=command))
    if len(cells) > MAX_CELLS:
        raise UsageError(f"--grid: expects at most {MAX_CELLS:,} runs, not {len(cells):,}")
    return cells


def _task_folder(task: str, run_flags: Sequence[str]) -> str:
    """The name of the folder of a task's runs. An environment of one's own is made to know its name."""
    if not is_factory(task):
        return run_config.task_folder(task)
    parsed = flags.parse(["run", "--algo=td3", f"--env={task}", *run_flags])
    assert parsed
    try:
        arguments = env_args.parse(parsed.settings.get("env_args", ""))
        env = make_from(task, arguments, parsed.settings.get("max_episode_steps", 0), 0)
    except ValueError as error:
        raise UsageError(f"--tasks: {task}: {error}") from None
    if env.host:
        env.host.close()
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


def finished(cell: Cell) -> dict[str, Any] | None:
    """The content of summary.json if the cell's run has ended, else None."""
    try:
        summary = json.loads((cell.path / "summary.json").read_text())
        return summary if summary["status"] in ("done", "diverged") else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def needs_training(cell: Cell) -> bool:
    """Whether a cell has to be started. One with --config always is: the run itself compares the file's settings."""
    return any(word.startswith("--config=") for word in cell.command) or not finished(cell)
