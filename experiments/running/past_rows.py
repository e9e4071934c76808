"""The rows of a run's tables so far, under the names of its TensorBoard events."""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

from sqt_jax import bias

EVALUATION = ("return_mean", "return_std", "episode_length_mean", "value_bias")
# Columns of metrics.csv that are no metrics, beside those of swept settings.
OTHERS = {"member", "env_steps", "gradient_steps", "seed", "penalty_coef", "wall_seconds", *bias.NAMES}
SWEPT_METRICS = {"temperature"}  # the column of this setting holds the metric of the same name


def past_rows(folder: Path, swept: Sequence[str]) -> Iterator[tuple[int, list[dict[str, float]]]]:
    """Environment steps and a row per member of each evaluation, in order; empty fields are left out.

    Args:
      folder: the run's; its tables are complete: each evaluation has all members.
      swept: the columns of swept settings.
    """
    others = OTHERS | {*swept} - SWEPT_METRICS
    metrics = {}
    if (folder / "metrics.csv").exists():
        for row in _read(folder / "metrics.csv"):
            values = {f"train/{name}": float(text) for name, text in row.items() if name not in others and text}
            metrics[row["env_steps"], row["member"]] = values
    found: dict[str, list[dict[str, float]]] = {}
    for row in _read(folder / "evaluations.csv"):
        values = {f"eval/{name}": float(row[name]) for name in EVALUATION if row[name]}
        found.setdefault(row["env_steps"], []).append(values | metrics.get((row["env_steps"], row["member"]), {}))
    for env_steps, rows in found.items():
        yield int(env_steps), rows


def _read(path: Path) -> Iterator[dict[str, str]]:
    with path.open(newline="") as file:
        yield from csv.DictReader(file)
