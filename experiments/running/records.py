"""The files of a run in `<out>/<env>/<algo>/<name>/`: tables, a summary, TensorBoard events."""

import contextlib
import csv
import errno
import json
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.commandline.arguments import DIVERGED, DONE, INTERRUPTED
from experiments.evidence.statistics import iqm, score
from experiments.running import files
from experiments.running.csv_rows import CsvTable, MissingRows
from experiments.running.events import Events
from experiments.running.loop import Outcome, Report
from experiments.running.past_rows import past_rows
from experiments.running.run_config import Member, label
from experiments.running.wandb_runs import WandbRuns
from sqt_jax import bias

# The columns of every evaluations.csv; swept settings other than penalty_coef follow.
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


class NotARun(Exception):
    """The folder holds other things than a run."""


# The files and folders of a run: no others are ever removed.
RUN_FILES = (
    "config.json",
    "config.json.part",
    "evaluations.csv",
    "metrics.csv",
    "summary.json",
    "summary.json.part",
    "curves.png",
    "error.txt",
    "wandb.json",
    "wandb.json.part",
)
RUN_FOLDERS = ("checkpoint", "policy", "policy.part", "policy_best", "policy_best.part", "tensorboard", "wandb")
# Left by a run that died before it wrote its config.json.
LEFTOVERS = {"lock", "config.json.part"}


def is_taken(path: Path) -> bool:
    """Whether `path` has files that a new run would be mixed with."""
    return path.is_dir() and any(item.name not in LEFTOVERS for item in path.iterdir())


def removable_files(path: Path) -> set[str]:
    """The names in `path` that `remove_run` would remove.

    Raises:
      NotARun: there are files without a config.json, files that are not a run's, or links.
      OSError: it is not a folder, or cannot be read.
    """
    if path.is_symlink():
        raise NotARun
    if not path.exists():
        return set()
    names = {item.name for item in path.iterdir()} - {"lock"}
    # wandb links its folders to a log file of its own. Removing a folder does not follow links.
    links = any(item.is_symlink() for item in path.rglob("*") if path / "wandb" not in item.parents)
    if links or (names and ("config.json" not in names or names - {*RUN_FILES, *RUN_FOLDERS})):
        raise NotARun
    return names


def find_link(path: Path) -> str | None:
    """The name of a link among the files of a run, which would be written elsewhere; None if there is none."""
    names = [*RUN_FILES, *RUN_FOLDERS, "lock", *(f"tensorboard/{item.name}" for item in path.glob("tensorboard/*"))]
    return next((name for name in names if (path / name).is_symlink()), None)


def remove_run(path: Path) -> None:
    """Removes the run in `path`, if there is one, except its lock. Raises as `removable_files`."""
    names = removable_files(path)
    for name in names & {*RUN_FOLDERS}:
        shutil.rmtree(path / name)
    # config.json last: a run that is only partly removed can still be removed or resumed.
    for name in sorted(names & {*RUN_FILES}, key=lambda name: name == "config.json"):
        (path / name).unlink()


class Records:
    """Writes the tables and events of one run during training; a context manager.

    Args:
      path: the run's folder, locked by this process (`folder_lock.locked`).
      swept: names of the swept settings.
      resumed_at: of a resumed run, the env steps of its checkpoint and the `lengths` there. Later rows are cut off,
        since training writes them again. None: a new run; existing tables are emptied.
      warn: called with a line of text when something cannot be written.

    Raises:
      MissingRows: the tables of a resumed run have lost rows.
      WrongColumns: they have other columns.
      OSError: the folder cannot be created or written.
    """

    def __init__(
        self,
        path: Path,
        members: Sequence[Member],
        swept: Sequence[str],
        tensorboard: bool = True,
        resumed_at: tuple[int, Mapping[str, int]] | None = None,
        warn: Callable[[str], None] = lambda line: None,
    ):
        path.mkdir(parents=True, exist_ok=True)
        env_steps, lengths = resumed_at or (None, {})
        for table in ("evaluations", "metrics"):  # before any of them is cut
            file = path / f"{table}.csv"
            if lengths.get(table, 0) > (file.stat().st_size if file.is_file() else 0):
                raise MissingRows(file.name)
        self.path, self.members, self.warn = path, members, warn
        self.swept = [name for name in swept if name != "penalty_coef"]
        columns = [*EVALUATION_COLUMNS, *self.swept]
        self._evaluations = CsvTable(path / "evaluations.csv", lengths.get("evaluations", 0), columns)
        # Created with the first metrics, when its columns are known.
        self._metrics: CsvTable | None = None
        self._metric_rows: list[dict[str, Any]] = []  # of the time before it could be created
        self._keep_metrics = lengths.get("metrics", 0)
        if not self._keep_metrics:
            (path / "metrics.csv").unlink(missing_ok=True)
        purge_step = None if env_steps is None else env_steps + 1  # earlier events from there on are ignored
        self._events: list[Events] = []
        if tensorboard:
            labels = [label(member, self.swept) for member in members]
            try:
                self._events = [Events(path / "tensorboard" / name, purge_step) for name in labels]
            except OSError as error:  # too many open files, no fsync, ...: the tables have the same numbers
                self.warn(f"no events for TensorBoard: {error.strerror}")
        self._disk_full = False
        self._wandb: WandbRuns | None = None
        self._exit_codes: list[int] | None = None  # of the members; None: the run has not ended

    def __enter__(self) -> "Records":
        return self

    def __exit__(self, *_: object) -> None:
        self._evaluations.close()
        if self._metrics:
            self._metrics.close()
        with contextlib.suppress(OSError):
            for events in self._events:
                events.close()
        if self._wandb:
            self._wandb.close(self._exit_codes)

    def track(self, runs: WandbRuns) -> None:
        """Sends the rows that TensorBoard gets to `runs` too, and those so far first. `runs` is closed at the end."""
        self._wandb = runs
        for env_steps, rows in past_rows(self.path, self.swept):
            runs.add(rows, env_steps)

    def lengths(self) -> dict[str, int]:
        """Bytes of each table, once its rows are on disk.

        Raises:
          OSError: the disk has no room for them.
        """
        if not self._write_metric_rows():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "metrics.csv")
        metrics = self._metrics.length() if self._metrics else self._keep_metrics
        return {"evaluations": self._evaluations.length(), "metrics": metrics}

    def report(self, report: Report) -> None:
        """Writes a row per member to evaluations.csv after an evaluation, and to metrics.csv if there were steps.

        If the disk is full, `warn` is called once; rows wait in memory, and TensorBoard events end.
        """
        written = True
        rows: list[dict[str, float]] = []  # as in TensorBoard
        for index, member in enumerate(self.members):
            metrics = {name: float(values[index]) for name, values in report.metrics.items()}
            bias_metrics = {name: float(values[index]) for name, values in report.bias.items()}
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
                # A diverged member is frozen: its critics are left out of the table.
                valid = not math.isnan(evaluation["return_mean"])
                measured = {name: metrics.get(name, math.nan) if valid else math.nan for name in ("q_mean", "q_std")}
                evaluation["value_bias"] = bias_metrics.get("value_bias", math.nan)
                written &= self._evaluations.write(row | evaluation | measured)
            if report.metrics:
                self._metric_rows.append(row | metrics | bias_metrics)
            values = {f"eval/{name}": value for name, value in evaluation.items()}
            values |= {f"train/{name}": value for name, value in metrics.items()}
            rows.append({name: value for name, value in values.items() if not math.isnan(value)})
            if self._events:
                try:
                    self._events[index].add(rows[-1], report.env_steps)
                except OSError as error:
                    self._events = []
                    self.warn(f"no more events for TensorBoard: {error.strerror}")
        # An interval that a signal has cut short is measured again, to its end, by the process that resumes.
        if self._wandb and report.returns is not None:
            self._wandb.add(rows, report.env_steps)
        written &= self._write_metric_rows()
        if not written and not self._disk_full:
            self.warn("the disk has no room for rows of evaluations.csv and metrics.csv: they are kept until it has")
        self._disk_full = not written

    def _write_metric_rows(self) -> bool:
        """Writes the rows that wait for metrics.csv, and creates it with the first; returns whether all are written."""
        try:
            if self._metrics is None and self._metric_rows:
                first = [name for name in self._metric_rows[0] if name != "wall_seconds"]
                columns = [*dict.fromkeys([*first, *bias.NAMES]), "wall_seconds"]
                self._metrics = CsvTable(self.path / "metrics.csv", self._keep_metrics, columns)
        except OSError:  # the rows are tried again with the next ones
            return False
        rows, self._metric_rows = self._metric_rows, []
        return all([self._metrics.write(row) for row in rows]) if self._metrics else True

    def summary(self, outcome: Outcome) -> dict[str, Any]:
        """Writes summary.json and returns its content."""
        table = read_evaluations(self.path / "evaluations.csv")
        otherwise = INTERRUPTED if outcome.interrupted else DONE
        self._exit_codes = [DIVERGED if i in outcome.diverged else otherwise for i in range(len(self.members))]
        summary = {
            "status": "interrupted" if outcome.interrupted else "diverged" if outcome.diverged else "done",
            "env_steps": outcome.env_steps,
            "gradient_steps": int(outcome.state.gradient_steps),
            "wall_seconds": round(outcome.wall_seconds, 3),
            "train_seconds": round(outcome.train_seconds, 3),
            "steps_per_second": outcome.steps_per_second,
            "diverged": [{"member": member, "env_steps": steps} for member, steps in outcome.diverged.items()],
        } | summarise(table)
        with files.atomic_file(self.path / "summary.json") as file:
            file.write((json.dumps(_without_nan(summary), indent=2, allow_nan=False) + "\n").encode())
        return summary


def read_evaluations(path: Path) -> dict[str, np.ndarray]:
    """The columns of an evaluations.csv; an empty field is NaN."""
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        columns, rows = reader.fieldnames or [], list(reader)
    return {name: np.array([float(row[name]) if row[name] else math.nan for row in rows]) for name in columns}


def swept_columns(table: Mapping[str, np.ndarray]) -> list[str]:
    """The columns of swept settings, by which members are grouped."""
    return ["penalty_coef", *(name for name in table if name not in EVALUATION_COLUMNS)]


def groups(table: Mapping[str, np.ndarray]) -> dict[tuple[float, ...], list[int]]:
    """Values of `swept_columns` -> the members with these values, in their order."""
    found: dict[tuple[float, ...], list[int]] = {}
    names = swept_columns(table)
    for member in sorted({int(value) for value in table["member"]}):
        row = int(np.argmax(table["member"] == member))
        found.setdefault(tuple(float(table[name][row]) for name in names), []).append(member)
    return found


def of_member(table: Mapping[str, np.ndarray], member: int, column: str) -> np.ndarray:
    """One member's values of a column, one per evaluation."""
    return table[column][table["member"] == member]


def summarise(table: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Scores and final returns of each group and each member, from the columns of evaluations.csv."""
    names = swept_columns(table)
    grouped, members = [], []
    for values, indices in groups(table).items():
        # After a crash between two rows, some members lack the last evaluation.
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


def _without_nan(value: Any) -> Any:
    """`value` with null for NaN and infinity, which JSON does not have."""
    if isinstance(value, Mapping):
        return {name: _without_nan(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
