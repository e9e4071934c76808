"""Finished runs on disk: found in and below folders, and read, a `Curves` for each seed."""

import csv
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.commandline.arguments import UsageError, printable

REQUIRED = ("member", "env_steps", "gradient_steps", "seed", "return_mean", "q_std")


class Curves(NamedTuple):
    """What one seed left."""

    run: Path
    seed: int
    settings: dict[str, Any]
    versions: dict[str, str]
    columns: dict[str, np.ndarray]  # of evaluations.csv, in the order of the env steps


def find(paths: Sequence[str]) -> tuple[list[Path], list[str]]:
    """The folders with a config.json among `paths` and below them, each once; and what was left out."""
    found: dict[Path, Path] = {}  # by their real paths
    notes = []
    for text in paths:
        path = Path(text)
        try:
            if not path.is_dir():
                what = "is no folder" if path.exists() else "there is no such folder"
                raise UsageError(f"{text}: {what}; RUNS expects folders of runs or folders above them")
            below, without = _below(path)
        except (OSError, ValueError) as error:
            if isinstance(error, UsageError):
                raise
            raise UsageError(f"{text}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
        if not below:
            raise UsageError(f"{text}: holds no run (there is no config.json in it or below it)")
        for run in below:
            found.setdefault(run.resolve(), run)
        notes += [f"left out: {folder} has an evaluations.csv, but no config.json" for folder in without]
    return list(found.values()), notes


def _below(path: Path) -> tuple[list[Path], list[Path]]:
    """Folders with a config.json, and those with an evaluations.csv alone."""

    def fail(error: OSError) -> None:
        raise error

    runs, without = [], []
    for parent, folders, names in os.walk(path, onerror=fail):
        folders.sort()
        if "config.json" in names:
            folders.clear()  # its own, such as checkpoint/
            runs.append(Path(parent))
        elif "evaluations.csv" in names:
            without.append(Path(parent))
    return runs, without


def read_run(path: Path) -> list[Curves]:
    """The members of a run that have an evaluation. Raises `UsageError` where its files cannot be understood."""
    from experiments.running import run_config  # brings JAX

    try:
        run = run_config.read(path)
        columns = _read_table(path / "evaluations.csv")
    except run_config.InvalidRunConfig as error:
        raise UsageError(f"{path}: {error}") from None
    except OSError as error:
        raise UsageError(f"{path}: its evaluations.csv cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise UsageError(f"{path}: its evaluations.csv is damaged: {error}") from None
    evaluated_on = run.content.get("evaluated_on")
    versions = {printable(name): printable(str(value)) for name, value in run.content["versions"].items()}
    found = []
    for index, member in enumerate(run.members):
        kept = columns["member"] == index
        if not kept.any():
            continue
        own = {name: column[kept] for name, column in columns.items()}
        order = np.argsort(own["env_steps"], kind="stable")
        own = {name: column[order] for name, column in own.items()}
        if (np.diff(own["env_steps"]) == 0).any() or not (own["seed"] == member.seed).all():
            raise UsageError(f"{path}: its evaluations.csv is damaged: member {index} has other rows than it should")
        settings, rows = member.config.flat(), run.content["replay_rows"]
        # A larger one trains the same; a run that was gone on with has that of its first steps.
        settings["replay_capacity"] = rows if rows < settings["steps"] else "all"
        if evaluated_on is not None:
            settings["eval_physics"] = evaluated_on
        # Of a member that had diverged by then; runs of an earlier version wrote its frozen critics' values.
        gone = np.isnan(own["return_mean"])
        own |= {name: np.where(gone, np.nan, own[name]) for name in ("q_mean", "q_std", "value_bias") if name in own}
        found.append(Curves(path, member.seed, settings, versions, own))
    if not set(columns["member"]) <= set(range(len(run.members))):
        raise UsageError(f"{path}: its evaluations.csv is damaged: it has members that its config.json has not")
    return found


def _read_table(path: Path) -> dict[str, np.ndarray]:
    """The columns of an evaluations.csv; a last line that was cut off is none. Raises `ValueError` or `OSError`."""
    text = path.read_text(encoding="utf-8")
    lines = [*csv.reader(text[: text.rfind("\n") + 1].splitlines())]
    if not lines:
        raise ValueError("it is empty")
    names, rows = lines[0], lines[1:]
    for name in names:  # they become names of files, and text in figures
        if not (name.isascii() and name.isidentifier()):
            raise ValueError(f"{name[:40]!r} is no name of a column")
    for name in REQUIRED:
        if name not in names:
            raise ValueError(f"it has no column {name}")
    for number, row in enumerate(rows, 2):
        if len(row) != len(names):
            raise ValueError(f"line {number} has {len(row)} fields instead of {len(names)}")
    columns = {
        name: np.array([float(row[index] or math.nan) for row in rows], float) for index, name in enumerate(names)
    }
    for name in ("member", "env_steps", "gradient_steps", "seed"):
        if not np.isfinite(columns[name]).all():
            raise ValueError(f"a field of {name} is empty")
    return columns
