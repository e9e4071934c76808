"""The loop of a study: rounds, repeated trials, and kills at any point."""

import shutil

import pytest
from tuned_runs import contents, make_study, run, train, write_cell

from experiments.commandline.arguments import DONE, FAILED, INTERRUPTED, UsageError
from experiments.launchers.cell import Ended
from experiments.tuning.study import Study


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a study that nothing interrupted, and its trials."""
    out = tmp_path_factory.mktemp("whole")
    study, code = run(out)
    assert code == DONE
    return out, contents(study)


def test_a_study_asks_trains_and_tells_in_batches(whole):
    out, trials = whole
    assert [attributes["batch"] for *_, attributes in trials] == [1] * 4 + [2] * 4 + [3] * 4
    assert [attributes["round_end"] for *_, attributes in trials] == [4] * 4 + [8] * 4 + [12] * 4
    assert sorted(path.name for path in (out / "trials/cheetah/td3_sqt").iterdir() if path.is_dir()) == [
        "batch_0001",
        "batch_0002",
        "batch_0003",
    ]
    for params, state, found, attributes in trials:
        coef = params["penalty_coef"]
        best = 100.5 - 100 * (coef - 0.3) ** 2
        assert state == ("PRUNED" if coef > 0.9 else "COMPLETE")
        assert found == (None if coef > 0.9 else pytest.approx(best))
        assert attributes["diverged_seeds"] == ([0, 1] if coef > 0.9 else [])
        assert attributes["scores"] == pytest.approx([best - 0.5, best + 0.5]) and attributes["env_steps"] == 50
    assert "PRUNED" in {state for _, state, *_ in trials}  # else the above says nothing of them


@pytest.mark.parametrize("torn", [False, True], ids=["between two lines", "within a line"])
def test_a_study_that_was_killed_ends_as_the_uninterrupted_one(whole, tmp_path, torn):
    """Killed after any line of the journal: while asking, before training, while training, while telling."""
    out, trials = whole
    lines = (out / "study.log").read_bytes().splitlines(keepends=True)
    for count in range(3 if torn else 0, len(lines), 5):
        killed = tmp_path / str(count)
        killed.mkdir()
        (killed / "study.log").write_bytes(b"".join(lines[:count]) + (lines[count][:20] if torn else b""))
        if count % 2:  # some are killed when the runs of their trials had ended
            begun = b"".join(lines[:count]).count(b'"round_end"') // 4
            for batch in range(1, begun + 1):
                name = f"trials/cheetah/td3_sqt/batch_{batch:04}"
                shutil.copytree(out / name, killed / name)
        study, code = run(killed)
        assert code == DONE and contents(study) == trials


def test_a_run_that_has_ended_is_read_and_not_trained_again(tmp_path):
    def killed(cells, on_end):
        for cell in cells:
            write_cell(cell)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, train=killed, trials=4)
    study, code = run(tmp_path, train=lambda *_: pytest.fail("it is trained"), trials=4)
    assert code == DONE and not study.running


@pytest.mark.parametrize("code", [INTERRUPTED, FAILED])
def test_a_batch_that_fails_ends_the_study_and_is_trained_again_with_its_values(tmp_path, code):
    def failing(cells, on_end):
        on_end(Ended(cells[0], code, "why"))
        return code

    study, ended = run(tmp_path, train=failing)
    assert ended == code
    values = [trial.params for trial in study.running]
    again, ended = run(tmp_path)
    assert ended == DONE and [trial.params for trial in again.trials[:4]] == values and len(again.trials) == 12


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), UsageError("--out: why")])
def test_a_result_that_cannot_be_written_is_raised_when_the_other_batches_have_ended(tmp_path, monkeypatch, error):
    told = []

    def failing(study, trial, result):
        told.append(trial.number)
        raise error

    with monkeypatch.context() as patch, pytest.raises(type(error), match="space|why"):
        patch.setattr(Study, "tell", failing)
        run(tmp_path, workers=2)
    # After a line that was torn, no other may be written.
    assert told == [0] and len([*(tmp_path / "trials/cheetah/td3_sqt").glob("*/summary.json")]) == 2
    study, code = run(tmp_path, workers=2, train=lambda *_: pytest.fail("it is trained again"), trials=8)
    assert code == DONE and not study.running


def test_a_signal_stops_before_more_is_asked_for(tmp_path):
    study, code = run(tmp_path, stop=lambda: True)
    assert code == INTERRUPTED and not study.trials


def test_a_round_has_a_batch_for_each_worker(tmp_path):
    seen = []

    def counting(cells, on_end):
        seen.append(len(cells))
        return train(cells, on_end)

    study, _ = run(tmp_path, train=counting, workers=2, trials=14)
    assert seen == [2, 2]
    assert [trial.user_attrs["batch"] for trial in study.trials] == [1] * 4 + [2] * 4 + [3] * 4 + [4] * 2


def test_more_trials_after_whole_rounds_continue_a_study_as_the_unbroken_one(whole, tmp_path):
    run(tmp_path, trials=8)
    study, _ = run(tmp_path, trials=12)
    assert contents(study) == whole[1]


def test_more_trials_after_a_smaller_round_do_not_fill_it_up(whole, tmp_path):
    """They are proposed with its results, which the trials of an unbroken study do not know in their round."""
    run(tmp_path, trials=10)
    study, _ = run(tmp_path, trials=12)
    assert [trial.user_attrs["batch"] for trial in study.trials] == [1] * 4 + [2] * 4 + [3] * 2 + [4] * 2
    same = [trial.params == params for trial, (params, *_) in zip(study.trials, whole[1], strict=True)]
    assert same == [True] * 10 + [False] * 2


def test_a_trial_with_the_values_of_an_earlier_one_gets_its_result(tmp_path):
    space, trained = "penalty_coef=0.1|0.3", []

    def counting(cells, on_end):
        trained.extend(word for cell in cells for word in cell.command if word.startswith("--penalty_coef"))
        return train(cells, on_end)

    study, code = run(tmp_path, make_study(tmp_path, space), train=counting)
    assert code == DONE and len(study.trials) == 12
    assert sorted(",".join(word.partition("=")[2] for word in trained).split(",")) == ["0.1", "0.3"]
    for trial in study.trials:
        assert trial.value == pytest.approx(100.5 - 100 * (trial.params["penalty_coef"] - 0.3) ** 2)


def test_lines_say_how_far_it_is(tmp_path):
    lines = []
    run(tmp_path, lines=lines, trials=8)
    assert len(lines) == 2 and lines[0].startswith("td3_sqt on cheetah, batch_0001: 4 trials") and " left" in lines[0]
