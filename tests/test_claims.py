"""The statements follow from the numbers they are given."""

import numpy as np
from made_curves import curves

from experiments.theorem import claims, contraction, q_learning


def test_a_verdict_states_in_how_many_rows_a_sign_holds():
    holds, undecided, other = (1.0, 0.5), (0.4, 0.5), (-0.6, 0.5)
    assert claims.verdict_of([holds, (0.6, 0.5)], +1) == "supported"
    assert claims.verdict_of([holds, undecided], +1) == "holds in 1 of 2 rows, undecided in 1"
    assert claims.verdict_of([holds] * 13 + [undecided, other], +1) == (
        "holds in 13 of 15 rows, the other way in 1, undecided in 1"
    )
    assert claims.verdict_of([holds, other], -1, "changes") == "holds in 1 of 2 changes, the other way in 1"
    assert claims.verdict_of([undecided, other], +1) == "holds in 0 of 2 rows, the other way in 1, undecided in 1"
    assert claims.verdict_of([other], +1) == "contradicted" and claims.verdict_of([other], -1) == "supported"
    assert claims.verdict_of([(1.0, np.nan)], +1) == claims.verdict_of([], +1) == "not shown"


def test_statements_follow_from_the_numbers():
    sqt = np.array([[-0.1], [-0.2]]) * np.ones(3)
    good = {
        ("grid", "q_learning"): curves(bias=0.3),
        ("grid", "maxmin"): curves(tables=2, bias=-0.1, std=(3, 2, 1)),
        ("grid", "sqt"): curves((0.0, 0.5), 2, bias=sqt, std=(3, 2, 1)),
        ("grid", "sqt_shared"): curves((0.0, 0.5), 2, bias=0.3),
    }
    checks = {
        claims.overestimation: {("grid", "q_learning"): curves(bias=-0.3)},
        claims.underestimation: {
            ("grid", "maxmin"): curves(tables=2, bias=0.1),
            ("grid", "sqt"): curves((0.5,), 2, bias=0.2),
        },
        claims.monotone: {("grid", "sqt"): curves((0.0, 0.5), 2, bias=-sqt)},
        claims.convergence: {names: curves(error=(1, 2, 3)) for names in good},
        claims.penalty: {("grid", "sqt"): curves((0.0, 0.5), 2, std=(1, 2, 3))},
        claims.identical: {("grid", "sqt_shared"): curves((0.0, 0.5), 2, std=1.0)},
        claims.during_learning: {("grid", "sqt"): curves((0.0, 0.5), 2, ratio=(0.5, 1.5, 0.5))},
    }
    for statement, bad in checks.items():
        assert statement(good).verdict == "supported", statement
        assert statement(good | bad).verdict == "contradicted", statement
        assert statement({}).verdict == "not shown" and "not run" in statement({}).evidence, statement
    one_row = good | {("grid", "maxmin"): curves(tables=2, bias=0.1)}
    partly = claims.underestimation(one_row)
    assert partly.verdict == "holds in 1 of 2 rows, the other way in 1"
    assert partly.evidence.endswith("The other way: grid, maxmin.")
    unclear = claims.underestimation(good | {("grid", "sqt"): curves((0.5,), 2, bias=-0.1, seeds=1)})
    assert unclear.evidence.endswith("Undecided: grid, sqt 0.5.")


def test_eq_16_is_contradicted_by_a_penalty_only():
    sqt = q_learning.algorithms()["sqt"]
    for coef, verdict in ((0.0, "supported"), (0.5, "contradicted")):
        found = contraction.expansions(sqt, [coef], 1, 2000)
        statement = claims.non_expansion(found, 4, 0.8, 1, 2000)
        assert statement.verdict == verdict
        assert f"{found[0].given:.4f}" in statement.evidence
        assert ("|T Q - T Q'| = 3/2 gamma" in statement.evidence) == (coef == 0.5)
