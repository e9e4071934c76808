"""The report of a tuning by hand: fresh seeds, paired intervals, optimism; tables that mark what was tuned."""

import csv
import io

import numpy as np
import pytest
from made_runs import write_run
from table_reader import cells
from tuned_runs import SEEDS, TASK, make_study, run, train, value

from experiments.commandline.arguments import UsageError
from experiments.evidence.comparisons import against_baseline
from experiments.evidence.paper_tables import table_2
from experiments.evidence.pooling import collect
from experiments.running import folder_lock
from experiments.tuning import score_figure
from experiments.tuning.batches import Task
from experiments.tuning.fresh_seeds import Winner, fresh_cell, fresh_seeds, show_only
from experiments.tuning.report import (
    AT_START,
    FEW,
    Setup,
    Tuned,
    make_table,
    paired,
    read_fresh,
    report_text,
    trials_csv,
    values_of,
)
from experiments.tuning.study import Result

FRESH = (2, 3, 4)
SETUP = Setup("score", SEEDS, FRESH, "penalty_coef=0..1", "tpe", "python -m experiments.tune ...")


def test_fresh_seeds_are_above_those_of_the_tuning():
    assert fresh_seeds((0, 1), 3) == (2, 3, 4) and fresh_seeds((7, 3), 2) == (8, 9)
    with pytest.raises(UsageError, match="^--seeds=4294967290: expects seeds with --final_seeds=10 larger ones"):
        fresh_seeds((4294967290,), 10)


def test_runs_of_earlier_winners_are_put_aside_with_their_files(tmp_path):
    cells = {name: TASK.cell(tmp_path / "final", name, FRESH) for name in ("trial_1_seeds_2-4", "trial_2_seeds_2-4")}
    for cell in cells.values():
        train([cell], lambda ended: None)
        cell.log.write_text(cell.path.name)
    final, aside = cell.path.parent, tmp_path / "trials" / "cheetah" / "td3_sqt"
    names = [(name, f"{name}.log.txt") for name in cells]
    for shown, hidden in ((0, 1), (1, 0)):
        show_only([[*cells.values()][shown]], tmp_path, print)
        assert {path.name for path in final.iterdir()} == {*names[shown]}
        assert {path.name for path in aside.iterdir()} == {*names[hidden]}


def test_a_run_that_still_trains_stays(tmp_path):
    old, new = (TASK.cell(tmp_path / "final", f"trial_{n}_seeds_2-4", FRESH) for n in (1, 2))
    lines = []
    with folder_lock.locked(old.path):
        show_only([new], tmp_path, lines.append)
        assert old.path.exists() and len(lines) == 1 and lines[0].startswith(f"{old.path} stays there")
    show_only([new], tmp_path, lines.append)
    assert not old.path.exists() and len(lines) == 1


def test_paired_differences_by_hand():
    found = paired(np.array([3.0, 5.0, 1.0, 2.0]), np.array([1.0, 2.0, 1.0, 3.0]))
    assert found["difference"] == 1.0 and found["share"] == 0.625
    assert -1.0 <= found["low"] < 1.0 < found["high"] <= 3.0
    # A constant gap has no spread, however far the seeds are apart.
    constant = paired(np.array([0.0, 100.0, 1000.0]), np.array([-5.0, 95.0, 995.0]))
    assert (constant["low"], constant["difference"], constant["high"]) == (5.0, 5.0, 5.0)
    assert paired(np.array([1.0]), np.array([2.0])) == {"difference": -1.0, "low": None, "high": None, "share": 0.0}


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    """A tuned algorithm and its baseline, with nothing to tune, and the folder."""
    out = tmp_path_factory.mktemp("tuned")
    study, _ = run(out)
    winners = [Winner(TASK, study, study.best), Winner(TASK._replace(algo="td3"), None, None)]
    found = []
    for winner in winners:
        cell = fresh_cell(winner, out, FRESH, "12 trials x 2 seeds")
        train([cell], lambda ended: None)
        found.append(Tuned(winner, read_fresh(cell.path)))
    return found, out


def test_the_winner_is_shown_on_fresh_seeds_beside_its_baseline(tuned):
    (one, other), _ = tuned
    coef = one.winner.trial.params["penalty_coef"]
    table = make_table([one, other], SETUP)
    first, second, difference = cells(table)
    tuning, fresh, plain = (
        np.mean([value(c, s) for s in seeds]) for c, seeds in ((coef, SEEDS), (coef, FRESH), (0, FRESH))
    )
    assert one.winner.trial.value == pytest.approx(tuning)
    assert first[0].startswith("td3_sqt") and first[1] == f"penalty_coef {coef:.4g}" and first[2].startswith("12")
    assert first[3] == f"{tuning:,.1f}" if tuning < 100 else f"{tuning:,.0f}"
    assert f"{fresh:,.0f}" in first[4] and "(3)" in first[4]
    assert table.records[0]["optimism"] == pytest.approx(tuning - fresh) and first[-1] == "-2.50"
    assert second[0].startswith("td3 ") and second[1:4] == ["-", "-", "-"] and second[-1] == "-"
    assert table.records[2]["score_difference"] == pytest.approx(fresh - plain)
    assert table.records[2]["score_share"] == 1.0 and "better in 100% of 3 seeds" in difference[4]
    assert FEW in table.notes and any("nothing of it is tuned" in note for note in table.notes)
    assert "has nothing to tune in this space" in table.caption


def test_the_report_has_the_winners_command(tuned):
    found, _ = tuned
    text = report_text(make_table(found, SETUP), found, SETUP, "tuning.png")
    coef = found[0].winner.trial.params["penalty_coef"]
    assert f"python -m experiments.run --algo=td3_sqt --env=cheetah --penalty_coef={coef}\n" in text
    assert "![The trials](tuning.png)" in text and SETUP.command in text


def test_all_trials_are_in_the_csv(tuned):
    (one, other), _ = tuned
    rows = list(csv.DictReader(io.StringIO(trials_csv([one.winner, other.winner]))))
    assert len(rows) == 12
    for row, trial in zip(rows, one.winner.study.trials, strict=True):
        assert float(row["penalty_coef"]) == trial.params["penalty_coef"] and row["batch"] == str(1 + trial.number // 4)
        assert row["value"] == ("" if trial.value is None else str(trial.value))
        assert [float(text) for text in row["per_seed"].split()] == pytest.approx(trial.user_attrs["scores"])


def test_a_figure_has_a_panel_for_each_setting(tuned):
    found, _ = tuned
    assert score_figure.draw(found, SETUP).startswith(b"\x89PNG")
    assert score_figure.draw(found[1:], SETUP) is None


def test_where_all_trials_diverged_nothing_is_trained_again(tmp_path):
    study = make_study(tmp_path)
    study.ask_round(2, 1)
    for trial in study.trials:
        study.tell(trial, Result(None, (None, None), 0, SEEDS))
    winner = Winner(TASK, study, study.best)
    assert not winner.is_trained and winner.diverged == 2
    table = make_table([Tuned(winner, None)], SETUP)
    assert cells(table)[0][1:] == ["-", "2 (2 diverged)", "-", "-", "-", "-"]
    assert "all its trials diverged" in table.notes


def test_a_score_from_before_training_has_a_footnote(tmp_path):
    study = make_study(tmp_path)
    study.ask_round(1, 1)
    study.tell(study.trials[0], Result(1.0, (1.0, 1.0), 0))
    table = make_table([Tuned(Winner(TASK, study, study.best), None)], SETUP)
    assert AT_START in table.notes


def test_tables_mark_what_was_tuned_and_leave_its_trials_out(tuned):
    _, out = tuned
    runs = collect([str(out)])
    assert {group.seeds for group in runs.groups} == {FRESH}  # none of the twelve trials
    assert [note for note in runs.notes if "trials of a tuning" in note] == [
        f"left out: {out}/trials, the trials of a tuning; given as one of RUNS it is shown"
    ]
    note = "settings tuned on other seeds: 12 trials x 2 seeds"
    table = table_2(runs, False)
    assert note in table.notes and [record.get("tuned", "") for record in table.records] == ["", note]
    assert f"td3_sqt on cheetah: {note}" in against_baseline(runs, False, "table2_improvement").notes
    assert len(collect([str(out / "trials")]).groups) == 12


def test_a_run_that_was_not_tuned_has_no_such_note(tmp_path):
    write_run(tmp_path)
    table = table_2(collect([str(tmp_path)]), False)
    assert not table.notes and "tuned" not in table.records[0]


def test_a_failed_seed_leaves_no_value():
    assert values_of(None, "score") is None


def test_a_baseline_that_is_tuned_too_is_said_to_be(tmp_path):
    study, _ = run(tmp_path, trials=4)
    winner = Winner(Task("td3", "cheetah", "cheetah", ()), study, study.best)
    caption = make_table([Tuned(winner, None), Tuned(winner, None)], SETUP).caption
    assert "td3, the baseline, was tuned over the settings of the space that it has" in caption
    assert caption.endswith(" with as many trials.")
    more, _ = run(tmp_path / "more", trials=8)
    first = Winner(TASK, more, more.best)
    caption = make_table([Tuned(first, None), Tuned(winner, None)], SETUP).caption
    assert caption.endswith(" with its whole grid.")
