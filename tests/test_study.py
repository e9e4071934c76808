"""The journal of a study: what it refuses, and what it repairs."""

import json

import pytest
from tuned_runs import contents, make_study, run

from experiments.commandline.arguments import UsageError
from experiments.tuning.space import parse_space
from experiments.tuning.study import LOCK_SECONDS, Result, most_trials, open_study


def test_results_are_told_and_read_again(tmp_path):
    study = make_study(tmp_path)
    study.ask_round(3, 1)
    assert [trial.number for trial in study.running] == [0, 1, 2] and study.best is None and study.result(0) is None
    results = [Result(1.0, (0.5, 1.5), 50), Result(None, (None, 2.0), 50, (0,)), Result(3.0, (3.0, 3.0), 100)]
    for trial, result in zip(study.trials, results, strict=True):
        study.tell(trial, result)
    again = make_study(tmp_path)
    assert contents(again) == contents(study) and not again.running
    assert [again.result(number) for number in range(3)] == results
    assert [trial.state.name for trial in again.trials] == ["COMPLETE", "PRUNED", "COMPLETE"]
    assert again.best.number == 2


def test_of_equal_trials_the_first_is_best(tmp_path):
    study = make_study(tmp_path)
    study.ask_round(3, 1)
    for trial, value in zip(study.trials, (1.0, 2.0, 2.0), strict=True):
        study.tell(trial, Result(value, (), 0))
    assert study.best.number == 1


def test_a_round_is_asked_once(tmp_path):
    study = make_study(tmp_path)
    study.ask_round(10, 2)
    assert len(study.trials) == 8
    study.ask_round(10, 0)
    assert len(study.trials) == 8
    study.ask_round(10, 2)
    assert len(study.trials) == 10 and study.trials[-1].user_attrs["round_end"] == 10


def test_a_grid_ends_with_its_combinations():
    axes = parse_space("penalty_coef=0..1:0.5,tau=0.1|0.2", "td3_sqt")
    assert most_trials(64, axes, "grid") == 6 and most_trials(4, axes, "grid") == 4
    assert most_trials(64, axes, "tpe") == 64
    assert most_trials(64, parse_space("penalty_coef=0..1", "td3_sqt"), "tpe") == 64


def test_another_space_is_rejected(tmp_path):
    run(tmp_path, trials=4)
    before = (tmp_path / "study.log").read_bytes()
    with pytest.raises(UsageError) as error:
        make_study(tmp_path, "penalty_coef=0..2")
    assert str(error.value) == (
        f"--out={tmp_path}: expects the settings of the study there; these differ: "
        "space (its own: penalty_coef=0..1, now: penalty_coef=0..2)"
    )
    assert (tmp_path / "study.log").read_bytes() == before


def test_two_algorithms_have_a_study_each_in_one_file(tmp_path):
    for algo, space in (("td3_sqt", "penalty_coef=0..1"), ("sac_sqt", "tau=0..1")):
        study = make_study(tmp_path, space, algo=algo)
        study.ask_round(2, 1)
    assert [list(trial.params) for trial in make_study(tmp_path).trials] == [["penalty_coef"]] * 2


@pytest.mark.parametrize(
    "content",
    [
        b"hello\n",
        b"{}\n",
        b"[1]\n",
        b"\xff\xfe\n",
        b'{"op_code":99}\n',
        b'{"op_code":0,"worker_id":"a","study_name":"td3_sqt","directions":[7]}\n',
    ],
)
def test_a_damaged_file_is_rejected_in_one_line(tmp_path, content):
    (tmp_path / "study.log").write_bytes(content)
    with pytest.raises(UsageError) as error:
        make_study(tmp_path)
    assert str(error.value).startswith(f"--out={tmp_path}: expects ") and "\n" not in str(error.value)


def test_trials_that_this_command_did_not_write_are_rejected(tmp_path):
    study = make_study(tmp_path)
    study.ask_round(2, 1)
    path = tmp_path / "study.log"
    path.write_text(path.read_text().replace('"round_end"', '"other"'))
    with pytest.raises(UsageError, match="^--out: expects a study of this command; trial 1 of study.log has no round_"):
        make_study(tmp_path).ask_round(4, 1)
    empty = json.loads(path.read_text().splitlines()[0])
    path.write_text("".join(line + "\n" for line in path.read_text().splitlines() if '"settings"' not in line))
    assert empty["study_name"] == "td3_sqt"
    with pytest.raises(UsageError, match="these differ: it has none$"):
        make_study(tmp_path)


def test_the_lock_of_a_killed_process_is_removed(tmp_path, monkeypatch):
    make_study(tmp_path)
    (tmp_path / "study.log.lock").touch()
    waits = iter(range(1000))
    monkeypatch.setattr("time.monotonic", lambda: float(next(waits)))
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    make_study(tmp_path).ask_round(1, 1)
    assert next(waits) > LOCK_SECONDS and not (tmp_path / "study.log.lock").exists()


def test_a_folder_that_cannot_be_made_is_an_os_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        open_study(tmp_path / "file" / "a", "td3_sqt", {})
