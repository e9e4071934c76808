"""What a run leaves in `<out>/<env>/<algo>/<name>/`: settings, tables, a summary, events for TensorBoard."""

import csv
import json
import math
import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy import stats
from tensorboardX import SummaryWriter

from experiments.loop import Outcome, Report
from sqt_jax.algorithms import eval_physics_of
from sqt_jax.config import Config

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
PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "brax", "gymnasium", "numpy", "sqt_jax")


class Member(NamedTuple):
    """One member of a run: a seed with one setting of the swept scalars."""

    seed: int
    config: Config


def make_members(seeds: Sequence[int], configs: Sequence[Config]) -> list[Member]:
    """Seeds times configurations; seeds vary fastest."""
    return [Member(seed, config) for config, seed in product(configs, seeds)]


class Score(NamedTuple):
    """The paper's "maximum average reward": the best evaluation of the mean over seeds."""

    mean: float
    std: float  # population std over the seeds, at that evaluation
    evaluation: int  # which one it is


def score(returns: np.ndarray) -> Score | None:
    """Score of `returns` [seeds, evaluations]; evaluations with a NaN do not count. None if there is no other."""
    mean = returns.mean(axis=0)
    if not np.isfinite(mean).any():
        return None
    best = int(np.nanargmax(np.where(np.isfinite(mean), mean, np.nan)))
    return Score(float(mean[best]), float(returns[:, best].std()), best)


class RunExists(Exception):
    """The run directory already holds a run."""


class NotARun(Exception):
    """The directory holds something else than a run."""


# What a run leaves: nothing else is ever removed.
RUN_FILES = ("config.json", "evaluations.csv", "metrics.csv", "summary.json", "summary.json.part", "curves.png")
RUN_FOLDERS = ("policy", "tensorboard")


def remove_run(path: Path) -> None:
    """Removes the run in `path`, if there is one.

    Raises:
      NotARun: what is there is not a run alone: there is no config.json, there are other files, or links.
      OSError: a file cannot be removed.
    """
    if not path.exists():
        return
    names = {item.name for item in path.iterdir()}
    links = path.is_symlink() or any(item.is_symlink() for item in path.rglob("*"))
    if names and ("config.json" not in names or names - {*RUN_FILES, *RUN_FOLDERS} or links):
        raise NotARun
    for name in names & {*RUN_FOLDERS}:
        shutil.rmtree(path / name)
    for name in names & {*RUN_FILES}:
        (path / name).unlink()


class Records:
    """Writes the files of one run as it goes; a context manager.

    Raises:
      RunExists: the directory is not empty. Of two runs that start at once with one name, one gets it.
      OSError: the directory cannot be made or written.
    """

    def __init__(self, path: Path, members: Sequence[Member], swept: Sequence[str], tensorboard: bool = True):
        path.mkdir(parents=True, exist_ok=True)
        if any(path.iterdir()):
            raise RunExists
        try:
            self._config = (path / "config.json").open("x")
        except FileExistsError:
            raise RunExists from None
        self.path, self.members = path, members
        self.swept = [name for name in swept if name != "penalty_coef"]
        self._evaluations = _Table(path / "evaluations.csv", [*EVALUATION_COLUMNS, *self.swept])
        self._metrics: _Table | None = None  # its columns are known with the first metrics
        self._events = (
            [SummaryWriter(str(path / "tensorboard" / _label(member, self.swept))) for member in members]
            if tensorboard
            else []
        )

    def __enter__(self) -> "Records":
        return self

    def __exit__(self, *_: object) -> None:
        self._config.close()
        self._evaluations.close()
        if self._metrics:
            self._metrics.close()
        for writer in self._events:
            writer.close()

    def config(self, values: Mapping[str, Any]) -> None:
        with self._config as file:
            _write_json(file, values)

    def report(self, report: Report) -> None:
        """A row per member in evaluations.csv where there was an evaluation, in metrics.csv where there were steps."""
        if report.metrics and self._metrics is None:
            columns = ["member", "env_steps", "gradient_steps", "seed", "penalty_coef", *self.swept, *report.metrics]
            # SAC's temperature is a metric too, and says the same where it is swept.
            self._metrics = _Table(self.path / "metrics.csv", [*dict.fromkeys(columns), "wall_seconds"])
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
        temporary = self.path / "summary.json.part"
        with temporary.open("w") as file:
            _write_json(file, summary)
        temporary.rename(self.path / "summary.json")
        return summary


class _Table:
    """A CSV file whose rows are on disk as soon as they are written."""

    def __init__(self, path: Path, columns: Sequence[str]):
        self._file = path.open("x", newline="")
        self._writer = csv.DictWriter(self._file, columns, restval="", lineterminator="\n")
        self._writer.writeheader()
        self._file.flush()

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
                    "iqm": float(stats.trim_mean(final, 0.25)),
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


def describe(members: Sequence[Member], swept: Sequence[str], command: Sequence[str], preset: str) -> dict[str, Any]:
    """What config.json holds: the settings (of the first member), the members, and what they ran on."""
    device = jax.local_devices()[0]
    return {
        "settings": members[0].config.flat(),
        "preset": preset,
        "evaluated_on": eval_physics_of(members[0].config),
        "members": [
            {"member": index, "seed": member.seed}
            | {name: getattr(member.config.agent, name) for name in dict.fromkeys(["penalty_coef", *swept])}
            for index, member in enumerate(members)
        ],
        "command": list(command),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "device": {"platform": device.platform, "kind": device.device_kind, "cpus": os.cpu_count()},
        "commit": _commit(),
        "versions": {name: _version(name) for name in PACKAGES},
    }


def default_name(changed: Mapping[str, Any], now: datetime) -> str:
    """A run's name from the settings that differ from the defaults, and the time (UTC)."""

    def text(value: Any) -> str:
        return "+".join(map(str, value)) if isinstance(value, tuple) else str(value)

    words = [f"{name}={text(value)}" for name, value in changed.items()]
    # File names end at 255 bytes; which settings they were is in config.json.
    label = "_".join(words)[:180].replace("/", "-")
    return "_".join(filter(None, [label, now.strftime("%Y%m%dT%H%M%SZ")]))


def _label(member: Member, swept: Sequence[str]) -> str:
    words = [f"{name}={getattr(member.config.agent, name):g}" for name in ("penalty_coef", *swept)]
    return ",".join([f"seed={member.seed}", *words])


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The commit of the checkout this file belongs to, with `+changes` where files differ; None without one."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)  # not some other repository around an installation
        return git("rev-parse", "HEAD") + ("+changes" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _write_json(file: Any, values: Mapping[str, Any]) -> None:
    json.dump(_without_nan(values), file, indent=2, allow_nan=False)
    file.write("\n")


def _without_nan(value: Any) -> Any:
    """JSON has no NaN and no infinity: null."""
    if isinstance(value, Mapping):
        return {name: _without_nan(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
