"""A new row of `ALGORITHMS`, and an algorithm that has none."""

import numpy as np
import pytest
from figure_reader import legend_of
from made_runs import made_member, write_run
from table_reader import cells

from experiments.evidence import figures, paper_tables
from experiments.evidence.comparisons import against_baseline
from experiments.evidence.figure_style import algorithm_style, styles
from experiments.evidence.paper_tables import table_4
from experiments.evidence.pooling import arrange, collect, pool
from experiments.evidence.variants import baseline_of, penalty_of, variant_with, variants_of
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.settings import Setting


@pytest.fixture
def td3_range(monkeypatch):
    """A row as a user adds it: TD3 with a new penalty, under a name that does not mention it."""
    row = ALGORITHMS["td3_sqt"]
    check = Setting.check
    monkeypatch.setattr(Setting, "check", lambda self, value: value == "range" or check(self, value))
    monkeypatch.setitem(ALGORITHMS, "careful", row._replace(settings={**row.settings, "penalty": "range"}))
    return "careful"


def test_the_rows_say_which_variant_is_which():
    assert {baseline_of(algo) for algo in ALGORITHMS} == {"td3", "sac", "td7", "maxmin", "redq"}
    assert variants_of("sac") == ["sac_sqt", "sac_sqt_tuple"] and variants_of("sac_sqt") == []
    assert (penalty_of("td3"), penalty_of("redq_sqt")) == ("none", "batch_std")
    assert variant_with("td7", "transition_std") == "td7_sqt_tuple" and variant_with("redq", "transition_std") is None


def test_a_new_row_is_compared_with_its_baseline(td3_range, tmp_path):
    write_run(tmp_path, "td3", curves=[[0, 0, 10]])
    write_run(tmp_path, td3_range, curves=[[0, 0, 12]])
    write_run(tmp_path, "td3_sqt_tuple", curves=[[0, 0, 11]])
    runs = collect([str(tmp_path)])
    td3, _, careful = runs.groups
    assert careful.algo == td3_range and runs.baseline(careful) == (td3, "")
    rows = cells(against_baseline(runs, False, "table2_improvement"))
    assert [row[:2] for row in rows] == [
        ["td3_sqt_tuple against td3", "+10.0 %|P 1.00"],
        ["careful against td3", "+20.0 %|P 1.00"],
    ]
    assert [row[0] for row in cells(table_4(runs, False))] == ["td3_sqt_tuple"]  # the paper's two penalties only


def test_a_new_row_has_its_baselines_colour_and_its_own_line(td3_range, monkeypatch, tmp_path):
    monkeypatch.setitem(ALGORITHMS, "other", ALGORITHMS[td3_range])
    names = ["td3", "td3_sqt", "td3_sqt_tuple", td3_range, "other"]
    for algo in names:
        write_run(tmp_path, algo)
    style = styles(collect([str(tmp_path)]).rows)
    assert {style[algo].colour for algo in (td3_range, "other")} == {style["td3"].colour}
    assert len({str(style[algo].line) for algo in names}) == len(names)
    assert algorithm_style("td3_sqt")[1] == algorithm_style("sac_sqt")[1]


def test_a_variant_of_a_new_baseline_has_a_style_too(monkeypatch):
    monkeypatch.setitem(ALGORITHMS, "ddpg", ALGORITHMS["td3"])
    monkeypatch.setitem(ALGORITHMS, "ddpg_plus", ALGORITHMS["td3_sqt"]._replace(baseline="ddpg"))
    assert algorithm_style("ddpg")[0] != algorithm_style("ddpg_plus")[0]
    assert algorithm_style("ddpg")[1] != algorithm_style("ddpg_plus")[1]


def test_an_unknown_algorithm_is_pooled_and_compared_with_nothing():
    members = [made_member("td9_sqt", seed=seed, penalty="batch_std", penalty_coef=0.5) for seed in (0, 1)]
    runs = arrange(pool([*members, made_member("td3"), made_member("td9_sqt", penalty="batch_std", penalty_coef=0.0)]))
    td3, zero, group = runs.groups
    assert (td3.algo, group.algo, group.seeds) == ("td3", "td9_sqt", (0, 1)) and zero.settings["penalty_coef"] == 0
    assert runs.baseline(group) == (None, "td9_sqt has no baseline")
    assert not against_baseline(runs, True, "table2_improvement").records
    np.testing.assert_array_equal(group.scores, [2, 2])
    assert {"table2", "table3", "seeds"} <= {table.name for table in paper_tables.make_tables(runs, True)}
    assert "td3" in legend_of(figures.over_time(runs, "return_mean", "iqm"))
