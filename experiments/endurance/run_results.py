"""The results of a finished run that must not depend on whether it was interrupted."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import orbax.checkpoint

from experiments.running import run_config
from experiments.running.run_policies import read_evaluations
from sqt_jax.policy_folders import BEST


def read_results(path: Path) -> dict[str, Any]:
    """All arrays of the last checkpoint and of the policies, the replay rows, and both tables without their times."""
    folder = max((path / "checkpoint").glob("step_*"))
    run = run_config.read(path)
    results: dict[str, Any] = dict(orbax.checkpoint.PyTreeCheckpointer().restore((folder / "state").absolute()))
    rows = []
    for file in sorted((path / "checkpoint").glob("rows_*.bin")):
        start, stop = (int(word) for word in file.stem.split("_")[1:])
        rows.append(np.fromfile(file, np.float32).reshape(len(run.members), stop - start, -1))
    # Files of rows that are no longer in the replay may remain.
    results["rows"] = np.concatenate(rows, axis=1)[:, -run.content["replay_rows"] :]
    for file in sorted(path.glob("policy*/member_*.npz")):
        with np.load(file) as policy:
            results |= {f"{file.parent.name}/{file.stem}/{name}": array for name, array in policy.items()}
    results["best evaluations"] = list(read_evaluations(path / BEST).items())
    for name in ("evaluations", "metrics"):
        with (path / f"{name}.csv").open(newline="") as table:
            results[name] = [
                {column: value for column, value in row.items() if column != "wall_seconds"}
                for row in csv.DictReader(table)
            ]
    return results


def differences(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Names of the results that are not bit-identical."""
    return [name for name in one.keys() | other.keys() if not _identical(one.get(name), other.get(name))]


def _identical(a: Any, b: Any) -> bool:
    if isinstance(a, list):
        return a == b
    a, b = np.asarray(a), np.asarray(b)
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
