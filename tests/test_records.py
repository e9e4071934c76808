"""The tables, summary and events of a run."""

import csv
import errno
import json
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.running import csv_rows, records
from experiments.running.loop import Outcome, Report
from experiments.running.records import (
    EVALUATION_COLUMNS,
    Records,
    read_evaluations,
    summarise,
)
from experiments.running.run_config import make_members
from sqt_jax.experiment import make_config


def members_of(*, seeds=(3, 5), **swept):
    name, values = next(iter(swept.items())) if swept else ("penalty_coef", [0.5])
    return make_members(seeds, [make_config("sac_sqt", "ant", **{name: value}) for value in values])


def report(env_steps, returns, metrics=None, **bias):
    """A report of as many members as `returns` has rows."""
    returns = np.array(returns, np.float32) if returns is not None else None
    metrics = {name: np.array(values) for name, values in (metrics or {}).items()}
    lengths = np.full(returns.shape, 100) if returns is not None else None
    bias = {name: np.array(values) for name, values in bias.items()}
    return Report(env_steps, env_steps // 2, env_steps / 8, metrics, returns, lengths, bias)


def outcome(**changes):
    values = dict(
        state=SimpleNamespace(gradient_steps=np.int32(10)),
        env_steps=20,
        interrupted=False,
        diverged={},
        wall_seconds=2.5,
        train_seconds=1.0,
        steps_per_second=40.0,
    )
    return Outcome(**(values | changes))


def test_seeds_vary_fastest():
    members = members_of(penalty_coef=[0.1, 0.5])
    assert [(m.seed, m.config.agent.penalty_coef) for m in members] == [(3, 0.1), (5, 0.1), (3, 0.5), (5, 0.5)]


def test_evaluations_have_exactly_the_agreed_columns(tmp_path):
    with Records(tmp_path / "run", members_of(), ["penalty_coef"], tensorboard=False) as records:
        records.report(report(0, [[1, 3], [5, 5]]))
        metrics = {"q_std": [0.25, 0.5], "q_mean": [1.0, 2.0], "loss": [np.nan, 1.0]}
        records.report(report(20, [[2, 4], [6, 8]], metrics, value_bias=[-1.5, np.nan], value_bias_min=[-2.0, -3.0]))
        # Rows are on disk at once: the files are still open here.
        text = (tmp_path / "run" / "evaluations.csv").read_text()
    assert text == (
        "member,env_steps,gradient_steps,seed,penalty_coef,return_mean,return_std,episode_length_mean,"
        "q_mean,q_std,value_bias,wall_seconds\n"
        "0,0,0,3,0.5,2.0,1.0,100.0,,,,0.0\n"
        "1,0,0,5,0.5,5.0,0.0,100.0,,,,0.0\n"
        "0,20,10,3,0.5,3.0,1.0,100.0,1.0,0.25,-1.5,2.5\n"
        "1,20,10,5,0.5,7.0,1.0,100.0,2.0,0.5,,2.5\n"
    )
    assert (tmp_path / "run" / "metrics.csv").read_text() == (
        "member,env_steps,gradient_steps,seed,penalty_coef,q_std,q_mean,loss,"
        "value_bias,value_bias_min,value_bias_normalised,wall_seconds\n"
        "0,20,10,3,0.5,0.25,1.0,,-1.5,-2.0,,2.5\n"
        "1,20,10,5,0.5,0.5,2.0,1.0,,-3.0,,2.5\n"
    )


def test_critics_of_a_member_that_diverged_are_in_no_row_of_evaluations(tmp_path):
    with Records(tmp_path / "run", members_of(), [], tensorboard=False) as records:
        metrics = {"q_std": [0.25, 0.5], "q_mean": [1.0, 2.0]}
        records.report(report(10, [[2.0], [6.0]], metrics))
        records.report(report(20, [[2.0], [np.nan]], metrics))
    table = read_evaluations(tmp_path / "run" / "evaluations.csv")
    for name in ("q_std", "q_mean"):
        assert np.isnan(table[name]).tolist() == np.isnan(table["return_mean"]).tolist() == [False] * 3 + [True]


def test_other_swept_scalars_are_further_columns(tmp_path):
    with Records(tmp_path / "run", members_of(temperature=[0.1, 0.2]), ["temperature"], tensorboard=False) as records:
        records.report(report(20, [[1.0]] * 4, {"temperature": [0.1, 0.1, 0.2, 0.2]}))
    rows = list(csv.DictReader((tmp_path / "run" / "evaluations.csv").open()))
    assert tuple(rows[0]) == (*EVALUATION_COLUMNS, "temperature")
    assert [row["temperature"] for row in rows] == ["0.1", "0.1", "0.2", "0.2"]
    header = (tmp_path / "run" / "metrics.csv").read_text().splitlines()[0].split(",")
    assert header[:6] == ["member", "env_steps", "gradient_steps", "seed", "penalty_coef", "temperature"]
    assert header.count("temperature") == 1 and header[-1] == "wall_seconds"


def test_rows_wait_where_metrics_csv_cannot_be_created_and_no_checkpoint_misses_them(tmp_path, monkeypatch):
    """A full disk at the first metrics: the run continues, and a checkpoint would not have these rows."""
    made, warnings = csv_rows.CsvTable, []

    def full(path, *arguments):
        if path.name == "metrics.csv":
            raise OSError(errno.ENOSPC, "No space left on device")
        return made(path, *arguments)

    with Records(tmp_path / "run", members_of(), [], tensorboard=False, warn=warnings.append) as written:
        monkeypatch.setattr(records, "CsvTable", full)
        written.report(report(10, [[2.0], [6.0]], {"q_std": [0.25, 0.5]}))
        assert len(warnings) == 1 and not (tmp_path / "run" / "metrics.csv").exists()
        with pytest.raises(OSError, match="No space left"):
            written.lengths()
        monkeypatch.setattr(records, "CsvTable", made)
        assert written.lengths()["metrics"] == (tmp_path / "run" / "metrics.csv").stat().st_size > 0
        written.report(report(20, [[3.0], [7.0]], {"q_std": [0.25, 0.5]}))
    with (tmp_path / "run" / "metrics.csv").open() as file:
        assert [row["env_steps"] for row in csv.DictReader(file)] == ["10", "10", "20", "20"]


def test_an_interval_without_an_evaluation_is_a_row_of_metrics_only(tmp_path):
    with Records(tmp_path / "run", members_of(), [], tensorboard=False) as records:
        records.report(report(20, None, {"loss": [1.0, 2.0]}))
    assert len((tmp_path / "run" / "evaluations.csv").read_text().splitlines()) == 1
    assert len((tmp_path / "run" / "metrics.csv").read_text().splitlines()) == 3


def test_summary_by_hand(tmp_path):
    with Records(tmp_path / "run", members_of(penalty_coef=[0.1, 0.5]), ["penalty_coef"], tensorboard=False) as records:
        q_std = {"q_std": [0.1, 0.2, 0.3, 0.4]}
        records.report(report(0, [[1.0], [3.0], [0.0], [0.0]]))
        records.report(report(10, [[3.0], [7.0], [2.0], [np.nan]], q_std))
        records.report(report(20, [[8.0], [0.0], [1.0], [np.nan]], q_std))
        summary = records.summary(outcome(diverged={3: 10}))
    assert json.loads((tmp_path / "run" / "summary.json").read_text()) == {
        "status": "diverged",
        "env_steps": 20,
        "gradient_steps": 10,
        "wall_seconds": 2.5,
        "train_seconds": 1.0,
        "steps_per_second": 40.0,
        "diverged": [{"member": 3, "env_steps": 10}],
        "groups": [
            {
                "penalty_coef": 0.1,
                "members": [0, 1],
                "seeds": [3, 5],
                "score": {"mean": 5.0, "std": 2.0, "env_steps": 10},
                "final": {"mean": 4.0, "std": 4.0, "iqm": 4.0},
            },
            {
                "penalty_coef": 0.5,
                "members": [2, 3],
                "seeds": [3, 5],
                "score": {"mean": 0.0, "std": 0.0, "env_steps": 0},
                "final": {"mean": None, "std": None, "iqm": None},
            },
        ],
        "members": [
            {"member": 0, "seed": 3, "penalty_coef": 0.1, "final_return": 8.0, "best_return": 8.0}
            | {"best_env_steps": 20, "q_std": 0.1},
            {"member": 1, "seed": 5, "penalty_coef": 0.1, "final_return": 0.0, "best_return": 7.0}
            | {"best_env_steps": 10, "q_std": 0.2},
            {"member": 2, "seed": 3, "penalty_coef": 0.5, "final_return": 1.0, "best_return": 2.0}
            | {"best_env_steps": 10, "q_std": 0.3},
            {"member": 3, "seed": 5, "penalty_coef": 0.5, "final_return": None, "best_return": 0.0}
            | {"best_env_steps": 0, "q_std": None},
        ],
    }
    assert summary["status"] == "diverged"


@pytest.mark.parametrize(
    ("changes", "status"),
    [({}, "done"), ({"diverged": {0: 5}}, "diverged"), ({"interrupted": True, "diverged": {0: 5}}, "interrupted")],
)
def test_status(tmp_path, changes, status):
    with Records(tmp_path / "run", members_of(), [], tensorboard=False) as records:
        assert records.summary(outcome(**changes))["status"] == status


def test_iqm_leaves_out_a_quarter_at_each_end(tmp_path):
    with Records(tmp_path / "run", members_of(seeds=range(8)), [], tensorboard=False) as records:
        records.report(report(0, [[value] for value in (0, 1, 2, 3, 4, 5, 6, 1000)]))
    summary = summarise(read_evaluations(tmp_path / "run" / "evaluations.csv"))
    assert summary["groups"][0]["final"]["iqm"] == np.mean([2, 3, 4, 5])


def test_a_last_evaluation_that_not_all_members_have_does_not_count(tmp_path):
    with Records(tmp_path / "run", members_of(), [], tensorboard=False) as records:
        records.report(report(0, [[1.0], [3.0]]))
        records.report(report(10, [[9.0], [9.0]]))
    path = tmp_path / "run" / "evaluations.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    group = summarise(read_evaluations(path))["groups"][0]
    assert group["score"]["mean"] == group["final"]["mean"] == 2.0


def test_events_for_tensorboard_are_written_per_member(tmp_path):
    with Records(tmp_path / "run", members_of(), ["penalty_coef"], tensorboard=True) as records:
        records.report(report(20, [[1.0], [2.0]], {"q_std": [0.25, np.nan]}))
    first, second = (tmp_path / "run" / "tensorboard" / f"seed={seed},penalty_coef=0.5" for seed in (3, 5))
    (events,) = first.iterdir()
    assert b"eval/return_mean" in events.read_bytes() and b"train/q_std" in events.read_bytes()
    (events,) = second.iterdir()
    assert b"eval/return_mean" in events.read_bytes() and b"train/q_std" not in events.read_bytes()


def test_only_a_runs_own_files_are_removed(tmp_path):
    path = tmp_path / "run"
    records.remove_run(path)  # does nothing
    (path / "policy").mkdir(parents=True)
    for name in ("config.json", "evaluations.csv", "policy/member_0.npz"):
        (path / name).write_text("x")
    records.remove_run(path)
    assert path.exists() and not any(path.iterdir())


def test_wandbs_link_to_its_log_is_removed_and_not_followed(tmp_path):
    path, log = tmp_path / "run", tmp_path / "core.log"
    log.write_text("x")
    (path / "wandb" / "run-1" / "logs").mkdir(parents=True)
    (path / "wandb" / "run-1" / "logs" / "debug-core.log").symlink_to(log)
    for name in ("config.json", "wandb.json"):
        (path / name).write_text("x")
    records.remove_run(path)
    assert log.exists() and not any(path.iterdir())


@pytest.mark.parametrize("kind", ["foreign file", "link", "linked folder", "no run"])
def test_a_folder_with_other_files_than_a_run_is_not_removed(tmp_path, kind):
    path, other = tmp_path / "run", tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("x")
    if kind == "link":
        path.symlink_to(other)
    else:
        path.mkdir()
        (path / "config.json" if kind != "no run" else path / "curves.png").write_text("x")
        if kind == "foreign file":
            (path / "thesis.tex").write_text("x")
        elif kind == "linked folder":
            (path / "policy").symlink_to(other)
    with pytest.raises(records.NotARun):
        records.remove_run(path)
    assert (other / "thesis.tex").exists() and (kind == "link" or any(path.iterdir()))
