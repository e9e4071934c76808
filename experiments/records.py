"""What a run leaves in `<out>/<env>/<algo>/<name>/`: tables, a summary, events for TensorBoard."""

import csv
import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tensorboardX import SummaryWriter

from experiments import files
from experiments.described import Member
from experiments.loop import Outcome, Report
from experiments.statistics import iqm, score

# The columns that every evaluations.csv has; further swept scalars follow.
EVALUATION_COLUMNS = (
    "member",
    "env_steps",
    "gradient_steps",
    "seed",
    "penalty_coef",
    "return_mean",
    "return_std",
    "episode_length_mean",
    "q_mean",
    "q_std",
    "value_bias",
    "wall_seconds",
)


class RunExists(Exception):
    """The run directory already holds a run."""


class Shortened(Exception):
    """A table holds less than a checkpoint says; its name."""


class NotARun(Exception):
    """The directory holds something else than a run."""


# What a run leaves: nothing else is ever removed.
RUN_FILES = (
    "config.json",
    "config.json.part",
    "evaluations.csv",
    "metrics.csv",
    "summary.json",
    "summary.json.part",
    "curves.png",
)
RUN_FOLDERS = ("checkpoint", "policy", "tensorboard")
# What a run that died before it began may have left.
LEFTOVERS = {"lock", "config.json.part"}


def is_taken(path: Path) -> bool:
    """Whether there is anything in `path` that a new run would mix with."""
    return path.is_dir() and any(item.name not in LEFTOVERS for item in path.iterdir())


def run_alone(path: Path) -> set[str]:
    """The names in `path` that `remove_run` may remove.

    Raises:
      NotARun: what is there is not a run alone: there is no config.json, there are other files, or links.
      OSError: it is no folder, or cannot be read.
    """
    if not path.exists() and not path.is_symlink():
        return set()
    names = {item.name for item in path.iterdir()} - {"lock"}
    links = path.is_symlink() or any(item.is_symlink() for item in path.rglob("*"))
    if links or (names and ("config.json" not in names or names - {*RUN_FILES, *RUN_FOLDERS})):
        raise NotARun
    return names


def link_in(path: Path) -> str | None:
    """The name of a link in `path` that a run would write through; None where there is none."""
    names = [*RUN_FILES, *RUN_FOLDERS, "lock", *(f"tensorboard/{item.name}" for item in path.glob("tensorboard/*"))]
    return next((name for name in names if (path / name).is_symlink()), None)


def remove_run(path: Path) -> None:
    """Removes the run in `path`, if there is one, but for its lock. Raises as `run_alone`."""
    names = run_alone(path)
    for name in names & {*RUN_FOLDERS}:
        shutil.rmtree(path / name)
    for name in names & {*RUN_FILES}:
        (path / name).unlink()


class Records:
    """Writes the tables and events of one run as it goes; a context manager.

    Args:
      path: the run's folder, which is this process's own (`files.locked`).
      resumed_at: where a run is gone on with, the env steps and what `lengths` gave there: what was written later is
        cut off, for training writes it again.

    Raises:
      RunExists: there is something in the folder already, and no run is resumed.
      Shortened: the tables of a run that is resumed have lost rows.
      OSError: the folder cannot be made or written.
    """

    def __init__(
        self,
        path: Path,
        members: Sequence[Member],
        swept: Sequence[str],
        tensorboard: bool = True,
        resumed_at: tuple[int, Mapping[str, int]] | None = None,
    ):
        path.mkdir(parents=True, exist_ok=True)
        if resumed_at is None and is_taken(path):
            raise RunExists
        env_steps, lengths = resumed_at or (None, {})
        for table in ("evaluations", "metrics"):  # before one of them is cut
            file = path / f"{table}.csv"
            if lengths.get(table, 0) > (file.stat().st_size if file.is_file() else 0):
                raise Shortened(file.name)
        self.path, self.members = path, members
        self.swept = [name for name in swept if name != "penalty_coef"]
        self._evaluations = _Table(
            path / "evaluations.csv", lengths.get("evaluations", 0), [*EVALUATION_COLUMNS, *self.swept]
        )
        # Its columns are known with the first metrics.
        self._metrics: _Table | None = None
        if lengths.get("metrics", 0):
            self._metrics = _Table(path / "metrics.csv", lengths["metrics"])
        else:
            (path / "metrics.csv").unlink(missing_ok=True)
        purge_step = None if env_steps is None else env_steps + 1  # events from there on do not count
        self._events = (
            [
                SummaryWriter(str(path / "tensorboard" / _label(member, self.swept)), purge_step=purge_step)
                for member in members
            ]
            if tensorboard
            else []
        )

    def __enter__(self) -> "Records":
        return self

    def __exit__(self, *_: object) -> None:
        self._evaluations.close()
        if self._metrics:
            self._metrics.close()
        for writer in self._events:
            writer.close()

    def lengths(self) -> dict[str, int]:
        """Bytes of the tables, which are on disk by then."""
        return {"evaluations": self._evaluations.length(), "metrics": self._metrics.length() if self._metrics else 0}

    def report(self, report: Report) -> None:
        """A row per member in evaluations.csv where there was an evaluation, in metrics.csv where there were steps."""
        if report.metrics and self._metrics is None:
            columns = ["member", "env_steps", "gradient_steps", "seed", "penalty_coef", *self.swept, *report.metrics]
            # SAC's temperature is a metric too, and says the same where it is swept.
            self._metrics = _Table(self.path / "metrics.csv", 0, [*dict.fromkeys(columns), "wall_seconds"])
        for index, member in enumerate(self.members):
            metrics = {name: float(values[index]) for name, values in report.metrics.items()}
            row: dict[str, Any] = {
                "member": index,
                "env_steps": report.env_steps,
                "gradient_steps": report.gradient_steps,
                "seed": member.seed,
                "penalty_coef": member.config.agent.penalty_coef,
                "wall_seconds": round(report.wall_seconds, 3),
            }
            row |= {name: getattr(member.config.agent, name) for name in self.swept}
            evaluation: dict[str, float] = {}
            if report.returns is not None and report.lengths is not None:
                evaluation = {
                    "return_mean": float(report.returns[index].mean()),
                    "return_std": float(report.returns[index].std()),
                    "episode_length_mean": float(report.lengths[index].mean()),
                }
                measured = {name: metrics.get(name, math.nan) for name in ("q_mean", "q_std")}
                self._evaluations.write(row | evaluation | measured)
            if self._metrics and report.metrics:
                self._metrics.write(row | metrics)
            if self._events:
                values = {f"eval/{name}": value for name, value in evaluation.items()}
                values |= {f"train/{name}": value for name, value in metrics.items()}
                for name, value in values.items():
                    if not math.isnan(value):
                        self._events[index].add_scalar(name, value, report.env_steps)
                self._events[index].flush()

    def summary(self, outcome: Outcome) -> dict[str, Any]:
        """Writes summary.json and gives what is in it."""
        table = read_evaluations(self.path / "evaluations.csv")
        summary = {
            "status": "interrupted" if outcome.interrupted else "diverged" if outcome.diverged else "done",
            "env_steps": outcome.env_steps,
            "gradient_steps": int(outcome.state.agent.gradient_steps),
            "wall_seconds": round(outcome.wall_seconds, 3),
            "train_seconds": round(outcome.train_seconds, 3),
            "steps_per_second": outcome.steps_per_second,
            "diverged": [{"member": member, "env_steps": steps} for member, steps in outcome.diverged.items()],
        } | summarise(table)
        with files.whole_file(self.path / "summary.json") as file:
            file.write((json.dumps(_without_nan(summary), indent=2, allow_nan=False) + "\n").encode())
        return summary


class _Table:
    """A CSV file that outlives the process row by row.

    Of a file that exists, the first `keep` bytes stay; its columns are then its own.

    Raises:
      Shortened: it has fewer.
    """

    def __init__(self, path: Path, keep: int, columns: Sequence[str] = ()):
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        self._file = os.fdopen(descriptor, "r+", newline="")
        if os.fstat(descriptor).st_size < keep:
            self._file.close()
            raise Shortened(path.name)
        if keep:
            columns = next(csv.reader([self._file.readline()]))
        os.ftruncate(descriptor, keep)
        self._file.seek(keep)
        self._writer = csv.DictWriter(self._file, columns, restval="", lineterminator="\n")
        if not keep:
            self._writer.writeheader()
        self._file.flush()

    def length(self) -> int:
        self._file.flush()
        os.fsync(self._file.fileno())
        return os.fstat(self._file.fileno()).st_size

    def write(self, row: Mapping[str, Any]) -> None:
        self._writer.writerow({name: "" if value != value else value for name, value in row.items()})
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def read_evaluations(path: Path) -> dict[str, np.ndarray]:
    """The columns of an evaluations.csv, NaN where a field is empty."""
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        columns, rows = reader.fieldnames or [], list(reader)
    return {name: np.array([float(row[name]) if row[name] else math.nan for row in rows]) for name in columns}


def swept_columns(table: Mapping[str, np.ndarray]) -> list[str]:
    """The columns whose values tell the groups of a run apart."""
    return ["penalty_coef", *(name for name in table if name not in EVALUATION_COLUMNS)]


def groups(table: Mapping[str, np.ndarray]) -> dict[tuple[float, ...], list[int]]:
    """Values of `swept_columns` -> the members that have them, in the order of the members."""
    found: dict[tuple[float, ...], list[int]] = {}
    names = swept_columns(table)
    for member in sorted({int(value) for value in table["member"]}):
        row = int(np.argmax(table["member"] == member))
        found.setdefault(tuple(float(table[name][row]) for name in names), []).append(member)
    return found


def of_member(table: Mapping[str, np.ndarray], member: int, column: str) -> np.ndarray:
    """One member's values of a column, an entry per evaluation."""
    return table[column][table["member"] == member]


def summarise(table: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Groups with their score and final returns, and members with theirs, from the columns of evaluations.csv."""
    names = swept_columns(table)
    grouped, members = [], []
    for values, indices in groups(table).items():
        # A run that dies between two rows leaves one member an evaluation short.
        count = min(len(of_member(table, index, "return_mean")) for index in indices)
        returns = np.stack([of_member(table, index, "return_mean")[:count] for index in indices])
        env_steps = of_member(table, indices[0], "env_steps").astype(int)
        seeds = [int(of_member(table, index, "seed")[0]) for index in indices]
        settings: dict[str, Any] = dict(zip(names, values, strict=True))
        best, final = score(returns), returns[:, -1]
        grouped.append(
            settings
            | {
                "members": indices,
                "seeds": seeds,
                "score": {
                    "mean": best.mean if best else None,
                    "std": best.std if best else None,
                    "env_steps": env_steps[best.evaluation].item() if best else None,
                },
                "final": {
                    "mean": float(final.mean()),
                    "std": float(final.std()),
                    "iqm": float(iqm(final)),
                },
            }
        )
        for index, seed, own in zip(indices, seeds, returns, strict=True):
            peak = int(np.nanargmax(own)) if np.isfinite(own).any() else None
            members.append(
                {"member": index, "seed": seed}
                | settings
                | {
                    "final_return": float(own[-1]),
                    "best_return": float(own[peak]) if peak is not None else None,
                    "best_env_steps": env_steps[peak].item() if peak is not None else None,
                    "q_std": float(of_member(table, index, "q_std")[count - 1]),
                }
            )
    return {"groups": grouped, "members": members}


def _label(member: Member, swept: Sequence[str]) -> str:
    words = [f"{name}={getattr(member.config.agent, name):g}" for name in ("penalty_coef", *swept)]
    return ",".join([f"seed={member.seed}", *words])


def _without_nan(value: Any) -> Any:
    """JSON has no NaN and no infinity: null."""
    if isinstance(value, Mapping):
        return {name: _without_nan(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
