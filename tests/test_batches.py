"""The run of a batch, and the values of its trials by hand."""

import json

import numpy as np
import pytest
from tuned_runs import SEEDS, TASK, make_study, returns, write_cell

from experiments.commandline import flags
from experiments.commandline.arguments import UsageError
from experiments.tuning.batches import Task, batches_of, read_results, result_of
from experiments.tuning.study import Result

NAN = float("nan")


@pytest.mark.parametrize(
    ("curves", "objective", "result"),
    [
        ([[0, 5, 3], [0, 1, 4]], "score", Result(3.5, (3.0, 4.0), 100)),
        ([[0, 9, 3], [0, 1, 4]], "score", Result(5.0, (9.0, 1.0), 50)),
        ([[0, 9, 3], [0, 1, 4]], "final", Result(3.5, (3.0, 4.0), 100)),
        ([[0, 9, NAN], [0, 1, 4]], "score", Result(None, (9.0, 1.0), 50, (7,))),
        ([[0, 9, NAN], [0, 1, 4]], "final", Result(None, (None, 4.0), 100, (7,))),
        ([[NAN, NAN, NAN], [0, 1, 4]], "score", Result(None, (None, 4.0), 100, (7,))),
        ([[NAN, NAN, NAN], [NAN, NAN, NAN]], "score", Result(None, (None, None), 100, (7, 8))),
    ],
)
def test_results_by_hand(curves, objective, result):
    assert result_of(np.array(curves, float), np.array([0.0, 50.0, 100.0]), (7, 8), objective) == result


@pytest.fixture
def batch(tmp_path):
    """A batch of three trials."""
    study = make_study(tmp_path)
    study.ask_round(3, 1)
    (batch,) = batches_of(study.trials, TASK, study.axes, tmp_path, SEEDS).values()
    return batch


def test_the_command_trains_the_trials_as_pairs(tmp_path):
    study = make_study(tmp_path, "penalty_coef=0..1,lr=log:1e-4..1e-3")
    study.ask_round(4, 1)
    task = Task("td3_sqt", "cheetah", "cheetah", ("--steps=1000",))
    (batch,) = batches_of(study.trials, task, study.axes, tmp_path, SEEDS).values()
    options = flags.parse(["run", *batch.cell.command])
    assert options.configurations == [(t.params["penalty_coef"], t.params["lr"]) for t in study.trials]
    assert (options.seeds, options.name, options.settings) == (SEEDS, "batch_0001", {"steps": 1000})
    assert batch.cell.path == tmp_path / "trials" / "cheetah" / "td3_sqt" / "batch_0001"


def test_results_are_those_of_the_trials_members(batch):
    write_cell(batch.cell)
    for objective, column in (("score", 1), ("final", 2)):
        found = read_results(batch, objective)
        for trial in batch.trials:
            own = [returns(trial.params["penalty_coef"], seed)[column] for seed in SEEDS]
            diverged = trial.params["penalty_coef"] > 0.9
            assert found[trial.number].value == (None if diverged else pytest.approx(np.mean(own)))


def test_runs_that_are_no_batch_of_the_study_are_rejected(tmp_path, batch):
    with pytest.raises(UsageError, match=r"^--out: .*batch_0001 cannot be read: .*; remove it to train it again$"):
        read_results(batch, "score")
    write_cell(batch.cell)
    file = batch.cell.path / "config.json"
    content = json.loads(file.read_text())
    content["members"][2]["penalty_coef"] = 0.123
    file.write_text(json.dumps(content))
    with pytest.raises(UsageError, match="^--out: .*batch_0001 has members of another study; expects another folder$"):
        read_results(batch, "score")
    (batch.cell.path / "evaluations.csv").write_text("member,env_steps\n")
    with pytest.raises(UsageError, match="cannot be read"):
        read_results(batch, "score")
