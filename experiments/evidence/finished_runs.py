"""Finds finished runs in and below folders, and reads a run's files as one `MemberCurves` per member."""

import csv
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.commandline.arguments import UsageError, printable
from experiments.evidence import run_settings

MAX_TUNED = 300  # characters of `tuned`
# What a tuning leaves: `experiments.tuning` has these names.
STUDY_FILE, TRIALS = "study.log", "trials"
REQUIRED = ("member", "env_steps", "gradient_steps", "seed", "return_mean", "q_std")


class MemberCurves(NamedTuple):
    """One member's settings and its rows of evaluations.csv."""

    run: Path  # the run's folder
    seed: int
    settings: dict[str, Any]  # all by name, without the seed
    versions: dict[str, str]  # of the packages
    columns: dict[str, np.ndarray]  # [evaluations] each, in the order of the env steps
    own_sizes: tuple[int, int] | None = None  # (observation, action) of an environment handed in from Python
    tuned: str = ""  # how its settings were tuned; empty: they were not


def find(paths: Sequence[str]) -> tuple[list[Path], list[str]]:
    """The folders with a config.json among and below `paths`, each once, and notes on folders that were left out.

    Raises:
      UsageError: a path is not a folder, cannot be read, or holds no run.
    """
    found: dict[Path, Path] = {}  # by resolved path
    notes = []
    for text in paths:
        path = Path(text)
        try:
            if not path.is_dir():
                problem = "is not a folder" if path.exists() else "does not exist"
                raise UsageError(f"{text}: {problem}; RUNS expects folders of runs or folders above them")
            below, without, tuning = _below(path)
        except (OSError, ValueError) as error:
            if isinstance(error, UsageError):
                raise
            raise UsageError(f"{text}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
        if not below:
            raise UsageError(f"{text}: contains no run (no config.json in it or below it)")
        for run in below:
            found.setdefault(run.resolve(), run)
        notes += [f"left out: {folder} has an evaluations.csv but no config.json" for folder in without]
        notes += [f"left out: {folder}, the trials of a tuning; given as one of RUNS it is shown" for folder in tuning]
    return list(found.values()), notes


def _below(path: Path) -> tuple[list[Path], list[Path], list[Path]]:
    """Folders with a config.json, those with an evaluations.csv only, and those with trials of a tuning, not searched.

    The best of many trials is no result: the winner is trained again on other seeds.
    """

    def fail(error: OSError) -> None:
        raise error

    runs, without, tuning = [], [], []
    for parent, folders, names in os.walk(path, onerror=fail):
        folders.sort()
        if STUDY_FILE in names and TRIALS in folders:
            folders.remove(TRIALS)
            tuning.append(Path(parent) / TRIALS)
        if "config.json" in names:
            folders.clear()  # the run's own folders, checkpoints for example
            runs.append(Path(parent))
        elif "evaluations.csv" in names:
            without.append(Path(parent))
    return runs, without, tuning


def read_run(path: Path) -> list[MemberCurves]:
    """The members of a run that have an evaluation.

    Raises:
      UsageError: config.json or evaluations.csv cannot be read or is damaged.
    """
    run = run_settings.read(path)
    try:
        columns = _read_table(path / "evaluations.csv")
    except OSError as error:
        raise UsageError(f"{path}: its evaluations.csv cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise UsageError(f"{path}: its evaluations.csv is damaged: {error}") from None
    evaluated_on = run.content.get("evaluated_on")
    own_env = run.content.get("own_env")
    own_sizes = (own_env["observation_size"], own_env["action_size"]) if own_env else None
    versions = {printable(name): printable(str(value)) for name, value in run.content["versions"].items()}
    found = []
    for index, (seed, settings) in enumerate(run.members):
        kept = columns["member"] == index
        if not kept.any():
            continue
        own = {name: column[kept] for name, column in columns.items()}
        order = np.argsort(own["env_steps"], kind="stable")
        own = {name: column[order] for name, column in own.items()}
        if (np.diff(own["env_steps"]) == 0).any() or not (own["seed"] == seed).all():
            raise UsageError(
                f"{path}: its evaluations.csv is damaged: member {index} has rows twice or of another seed"
            )
        rows = run.content["replay_rows"]
        # A replay that never overwrites trains the same, whatever its capacity. A resumed run keeps its first capacity.
        settings["replay_capacity"] = rows if rows < settings["steps"] else "all"
        if evaluated_on is not None:
            settings["eval_physics"] = evaluated_on
        if "env_version" in run.content:  # another version may be another task
            settings["env_version"] = printable(run.content["env_version"])
        # Runs of an earlier version recorded the frozen critics of members that had diverged.
        diverged = np.isnan(own["return_mean"])
        critics = [name for name in ("q_mean", "q_std", "value_bias") if name in own]
        own |= {name: np.where(diverged, np.nan, own[name]) for name in critics}
        found.append(
            MemberCurves(
                run=path,
                seed=seed,
                settings=settings,
                versions=versions,
                columns=own,
                own_sizes=own_sizes,
                tuned=tuned_text(run.content),
            )
        )
    if not set(columns["member"]) <= set(range(len(run.members))):
        raise UsageError(f"{path}: its evaluations.csv is damaged: it has members that config.json does not have")
    return found


def tuned_text(content: Mapping[str, Any]) -> str:
    """How the settings of a run were tuned, from its config.json; empty: they were not."""
    output = content.get("output")
    text = output.get("tuned") if isinstance(output, dict) else None
    return printable(text)[:MAX_TUNED] if isinstance(text, str) else ""


def _read_table(path: Path) -> dict[str, np.ndarray]:
    """The columns of an evaluations.csv, [rows] each; an incomplete last line is dropped.

    Raises:
      ValueError: it is damaged.
      OSError: it cannot be read.
    """
    text = path.read_text(encoding="utf-8")
    lines = [*csv.reader(text[: text.rfind("\n") + 1].splitlines())]
    if not lines:
        raise ValueError("it is empty")
    names, rows = lines[0], lines[1:]
    for name in names:  # they become file names, and texts in figures
        if not (name.isascii() and name.isidentifier()):
            raise ValueError(f"{name[:40]!r} is not a column's name")
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
