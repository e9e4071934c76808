"""Comparisons with baselines by hand: percentages, probabilities, intervals, footnotes."""

import pytest
from made_runs import write_run
from table_reader import cells

from experiments.evidence.cells import NOT_RESAMPLED
from experiments.evidence.comparisons import against_baseline
from experiments.evidence.pooling import collect


def test_improvement_by_hand(tmp_path):
    write_run(tmp_path, "td3", "cheetah", curves=[[0, 0, 10], [0, 0, 20]])
    write_run(tmp_path, "td3_sqt", "cheetah", curves=[[0, 0, 18], [0, 0, 18]])
    write_run(tmp_path, "td3", "ant", curves=[[0, 0, 4], [0, 0, 4]])
    write_run(tmp_path, "td3_sqt", "ant", curves=[[0, 0, 3], [0, 0, 5]])
    table = against_baseline(collect([str(tmp_path)]), False, "table2_improvement")
    ((label, cheetah, ant, over, chance),) = cells(table)
    assert label == "td3_sqt against td3"
    # 18 against a mean of 15, drawn from 10 to 20; it exceeds one of two.
    assert cheetah == "+20.0 % [-10.0, 80.0]|P 0.50 [0.00, 1.00]"
    assert ant == "+0.00 % [-25.0, 25.0]|P 0.50 [0.00, 1.00]"
    assert over.startswith("+10.0 % [") and chance.startswith("P 0.50 [")
    assert [record["env"] for record in table.records] == ["cheetah", "ant", "mean over tasks"]
    assert table.records[-1]["improvement_percent"] == pytest.approx(10)


def test_improvement_over_a_baseline_that_lost_or_was_not_run(tmp_path):
    write_run(tmp_path, "td3", curves=[[-5, -2, -4]])
    write_run(tmp_path, "td3_sqt", curves=[[0, 1, 2]])
    write_run(tmp_path, "sac_sqt")
    table = against_baseline(collect([str(tmp_path)]), False, "table2_improvement")
    assert cells(table) == [["td3_sqt against td3", "-|P 1.00 [1]"], ["sac_sqt against sac", "- [2]"]]
    assert table.notes == [
        "no percentage: the other mean is not positive",
        "no run of sac on cheetah to compare with",
    ]


def test_a_percentage_without_an_interval_says_why(tmp_path):
    write_run(tmp_path, "td3", curves=[[-9, -9, 5], [-9, -9, -1]])
    write_run(tmp_path, "td3_sqt", curves=[[0, 1, 3], [0, 1, 3]])
    table = against_baseline(collect([str(tmp_path)]), False, "table2_improvement")
    assert cells(table) == [["td3_sqt against td3", "+50.0 %|P 0.50 [0.00, 1.00] [1]"]]
    assert table.notes == ["no interval of the percentage: the other mean is not positive in some resamples"]


def test_a_side_with_one_seed_has_no_interval(tmp_path):
    write_run(tmp_path, "td3", curves=[[0, 0, 10]])
    write_run(tmp_path, "td3_sqt", curves=[[0, 0, 12], [0, 0, 18]])
    table = against_baseline(collect([str(tmp_path)]), False, "table2_improvement")
    assert cells(table) == [["td3_sqt against td3", "+50.0 %|P 1.00"]]


def test_a_comparison_says_which_of_the_two_is_incomplete(tmp_path):
    write_run(tmp_path, "td3", curves=[[0, 1]])
    write_run(tmp_path, "td3_sqt", curves=[[0, 2, 3]])
    table = against_baseline(collect([str(tmp_path)]), False, "table2_improvement")
    assert table.notes == ["td3 on cheetah: seed 0 stopped at step 50 of 100"]


def test_only_intervals_of_scores_have_the_note_on_the_choice(tmp_path):
    for algo in ("td3", "td3_sqt"):
        write_run(tmp_path, algo)
    runs = collect([str(tmp_path)])
    assert NOT_RESAMPLED in against_baseline(runs, False, "table2_improvement").caption
    assert NOT_RESAMPLED not in against_baseline(runs, False, "table3_change").caption


def test_the_papers_mean_improvements_are_shown_where_the_algorithm_is(tmp_path):
    for algo in ("td3", "td3_sqt", "sac"):
        write_run(tmp_path, algo)
    runs = collect([str(tmp_path)])
    rows = cells(against_baseline(runs, True, "table2_improvement"))
    assert [row[-2] for row in rows if "published" in row[0]] == ["+21.6 %"]
    rows = cells(against_baseline(runs, True, "table3_change"))
    assert [row[-2] for row in rows if "published" in row[0]] == ["+35.4 %"]
