"""The statements follow from the numbers they are given."""

from pathlib import Path

import numpy as np
import pytest
from made_curves import curves

from experiments.theorem import claims as report
from experiments.theorem import q_learning


def test_a_verdict_needs_all_rows_and_their_intervals():
    assert report.verdict_of([(1.0, 0.5), (0.6, 0.5)], +1) == "supported"
    assert report.verdict_of([(1.0, 0.5), (0.4, 0.5)], +1) == "not shown"
    assert report.verdict_of([(1.0, 0.5), (-0.6, 0.5)], +1) == "contradicted"
    assert report.verdict_of([(-0.6, 0.5)], -1) == "supported"
    assert report.verdict_of([(1.0, np.nan)], +1) == report.verdict_of([], +1) == "not shown"


def test_the_interval_is_students():
    # mean 2, std 1, four seeds: 3.182 / 2
    mean, width = report.interval(np.array([1.0, 1.0, 3.0, 3.0]) * 3**0.5 / 2)
    assert mean == pytest.approx(3**0.5) and width == pytest.approx(3.182446 / 2, rel=1e-5)


def test_statements_follow_from_the_numbers():
    sqt = np.array([[-0.1], [-0.2]]) * np.ones(3)
    good = {
        ("grid", "q_learning"): curves(bias=0.3),
        ("grid", "maxmin"): curves(tables=2, bias=-0.1, std=(3, 2, 1)),
        ("grid", "sqt"): curves((0.0, 0.5), 2, bias=sqt, std=(3, 2, 1)),
        ("grid", "sqt_shared"): curves((0.0, 0.5), 2, bias=0.3),
    }
    checks = {
        report.overestimation: {("grid", "q_learning"): curves(bias=-0.3)},
        report.underestimation: {("grid", "maxmin"): curves(tables=2, bias=0.1)},
        report.monotone: {("grid", "sqt"): curves((0.0, 0.5), 2, bias=-sqt)},
        report.convergence: {("grid", "maxmin"): curves(tables=2, error=(1, 2, 3))},
        report.penalty: {("grid", "sqt"): curves((0.0, 0.5), 2, std=(1, 2, 3))},
        report.identical: {("grid", "sqt_shared"): curves((0.0, 0.5), 2, std=1.0)},
        report.on_the_way: {("grid", "sqt"): curves((0.0, 0.5), 2, ratio=(0.5, 1.5, 0.5))},
    }
    for statement, bad in checks.items():
        assert statement(good).verdict == "supported", statement
        assert statement(good | bad).verdict == "contradicted", statement
        assert statement({}).verdict == "not shown" and "not run" in statement({}).evidence, statement
    other = report.underestimation(good | checks[report.underestimation])
    assert other.evidence.endswith("The other way: grid, maxmin.")


def test_eq_16_is_contradicted_by_a_penalty_only():
    sqt = q_learning.algorithms()["sqt"]
    for coef, verdict in ((0.0, "supported"), (0.5, "contradicted")):
        found = report.expansions(sqt, [coef], 1, 2000)
        statement = report.non_expansion(found, 4, 0.8, 1, 2000)
        assert statement.verdict == verdict
        assert f"{found[0].given:.4f}" in statement.evidence
        assert ("|T Q - T Q'| = 3/2 gamma" in statement.evidence) == (coef == 0.5)


def test_the_committed_table_has_todays_legend():
    table = Path(report.__file__).parent.parent / "results" / "tabular" / "table.md"
    assert "\n".join(report.LEGEND) in table.read_text(encoding="utf-8")
    assert "there are many intervals is not corrected for" in table.read_text(encoding="utf-8")


def test_rows_that_are_all_alike_are_one():
    found = report.cells({("grid", "sqt_shared"): curves((0.0, 0.5), 2), ("grid", "q_learning"): curves()})
    assert [row[:3] for row in found] == [("grid", "sqt_shared", "all alike"), ("grid", "q_learning", "-")]
    assert all(len(row) == len(report.HEADER) for row in found)
