"""Studies without training: runs written by hand in the place of `experiments.run`."""

import json

import numpy as np
import pytest
from made_runs import write_run

pytest.importorskip("optuna", reason="needs the extra tune")

from experiments.commandline.arguments import DIVERGED, DONE  # noqa: E402
from experiments.launchers.cell import Ended  # noqa: E402
from experiments.tuning.batches import Task  # noqa: E402
from experiments.tuning.space import parse_space  # noqa: E402
from experiments.tuning.study import Study, open_study  # noqa: E402
from experiments.tuning.tune_flags import Given  # noqa: E402
from experiments.tuning.tuner import Pace, Plan, run_study  # noqa: E402

SPACE = "penalty_coef=0..1"
TASK = Task("td3_sqt", "cheetah", "cheetah", ())
SEEDS = (0, 1)


GIVEN = Given(
    algo="td3_sqt",
    env="half_cheetah",
    space="penalty_coef=0..1,lr=log:1e-4..1e-3",
    trials=64,
    batch=16,
    seeds=["0", "1"],
    sampler="tpe",
    sampler_seed=0,
    objective="score",
    final_seeds=10,
    out="runs/tuned",
)


def value(coef, seed):
    """The made-up return at the end: best at 0.3."""
    return 100 - 100 * (coef - 0.3) ** 2 + seed


def returns(coef, seed):
    """The made-up returns, [3]; a member diverges above 0.9."""
    return [0, value(coef, seed), np.nan if coef > 0.9 else value(coef, seed) - 10]


def make_study(out, space=SPACE, sampler="tpe", batch=4, algo="td3_sqt"):
    """A study in the folder `out`, new or continued."""
    return Study(open_study(out, algo, {"space": space}), parse_space(space, algo), sampler, 0, batch)


def make_plan(out, trials=12, workers=1, objective="score"):
    return Plan(TASK, out, SEEDS, objective, trials, workers)


def write_cell(cell):
    """Writes the run of a cell as if it had been trained."""
    flags = dict(word.lstrip("-").partition("=")[::2] for word in cell.command)
    coefs = [float(text) for text in flags["penalty_coef"].split(",")] if "penalty_coef" in flags else [0.0]
    seeds = [int(text) for text in flags["seeds"].split(",")]
    curves = [returns(coef, seed) for coef in coefs for seed in seeds]
    swept = {"swept": {"penalty_coef": coefs}} if "penalty_coef" in flags else {}
    out = cell.path.parent.parent.parent
    path = write_run(out, cell.algo, cell.task, curves, seeds=seeds, name=cell.path.name, **swept)
    content = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps(content | {"output": {"tuned": flags.get("tuned", "")}}))
    diverged = bool(np.isnan(curves).any())
    summary = {"status": "diverged" if diverged else "done", "groups": [], "diverged": []}
    (path / "summary.json").write_text(json.dumps(summary))
    return DIVERGED if diverged else DONE


def train(cells, on_end):
    """Trains cells that are not there yet; returns the worst exit code."""
    codes = [DONE]
    for cell in cells:
        codes.append(write_cell(cell))
        on_end(Ended(cell, codes[-1], ""))
    return max(codes)


def run(out, study=None, stop=lambda: False, train=train, lines=None, **plan):
    """Runs a study to its end; returns it and the exit code."""
    study = study or make_study(out)
    code = run_study(study, make_plan(out, **plan), train, ([] if lines is None else lines).append, stop, Pace(100))
    return study, code


def contents(study):
    """What matters of all trials."""
    return [(trial.params, trial.state.name, trial.value, trial.user_attrs) for trial in study.trials]
