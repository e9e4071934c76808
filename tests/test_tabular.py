"""The command from end to end, and that its statements follow from the numbers they are given."""

import numpy as np
import pytest
from matplotlib.image import imread

from experiments import tabular, tabular_agents
from experiments import tabular_report as report

STEPS = np.array([100, 1000, 10_000])


def curves(coefs=(None,), tables=1, bias=0.1, error=(3.0, 2.0, 1.0), std=0.0, ratio=0.5, seeds=4):
    """Made up: a number or one per checkpoint for each quantity; seeds differ by a little."""
    spread = 1 + 0.01 * np.arange(seeds)[:, None, None]
    shape = (seeds, len(coefs), len(STEPS))

    def filled(value):
        return np.broadcast_to(np.asarray(value, float), shape) * spread

    record = report.Record(filled(error), filled(error), filled(bias), filled(std), filled(ratio))
    return report.Curves(tuple(coefs), STEPS, record, np.ones((seeds, len(coefs), tables, 2, 2)))


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
    sqt = tabular_agents.algorithms()["sqt"]
    for coef, verdict in ((0.0, "supported"), (0.5, "contradicted")):
        found = report.expansions(sqt, [coef], 1, 2000)
        statement = report.non_expansion(found, 4, 0.8, 1, 2000)
        assert statement.verdict == verdict
        assert f"{found[0].given:.4f}" in statement.evidence
        assert ("|T Q - T Q'| = 3/2 gamma" in statement.evidence) == (coef == 0.5)


def test_rows_that_are_all_alike_are_one():
    found = report.cells({("grid", "sqt_shared"): curves((0.0, 0.5), 2), ("grid", "q_learning"): curves()})
    assert [row[:3] for row in found] == [("grid", "sqt_shared", "all alike"), ("grid", "q_learning", "-")]
    assert all(len(row) == len(report.HEADER) for row in found)


def test_the_command_from_end_to_end(tmp_path, capsys):
    out = tmp_path / "new" / "tabular"
    argv = ["tabular", "--mdps=chain", "--algos=q_learning,sqt_shared", "--coefs=0,0.5", "--seeds=3", "--steps=400"]
    assert tabular.main([*argv, f"--out={out}"]) == 0
    shown, text = capsys.readouterr().out, (out / "table.md").read_text()
    assert "left" in shown and "Q-learning overestimates" in shown
    assert "By `python -m experiments.tabular --mdps=chain" in text and "3 seeds, 400 steps" in text
    assert text.count("| chain | q_learning | - |") == text.count("| chain | sqt_shared | all alike |") == 1
    assert "SQT is Q-learning then: supported" in text and "(eq. 16): contradicted" in text
    assert imread(out / "tabular.png").shape[0] > 800
    assert sorted(path.name for path in out.iterdir()) == ["table.md", "tabular.png"]

    assert tabular.main([*argv, f"--out={out}"]) == 2
    assert capsys.readouterr().err == f"--out={out}: is there already; takes another folder, or --overwrite beside it\n"
    assert tabular.parse([*argv, f"--out={out}", "--overwrite"])["overwrite"]


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("--mdps=maze", "--mdps: takes one of random, chain, grid, not 'maze'"),
        ("--mdps=", "--mdps: takes at least one"),
        ("--algos=q_learning,sarsa", "--algos: takes one of q_learning, "),
        ("--coefs=0,-1", "--coefs: takes numbers of at least 0 like 0,0.5, not '-1'"),
        ("--coefs=nan", "--coefs: takes numbers of at least 0"),
        ("--coefs=0,0.0", "--coefs: takes each value once, 0.0 is there 2 times"),
        ("--seeds=0", "--seeds: takes an integer in the range [1, 10000]"),
        ("--seeds=many", "--seeds: takes an integer in the range [1, 10000]"),
        ("--steps=1", "--steps: takes an integer in the range [100, 100000000]"),
        ("--tables=1", "--tables: takes an integer in the range [2, 100]"),
        ("--greedy=max", "--greedy: takes one of min, mean, penalised, not 'max'"),
        ("--gamma=1", "--gamma: takes a number from 0 to below 1, not 1"),
        ("--gamma=nan", "--gamma: takes a number"),
        ("--lr_power=0.5", "--lr_power: takes a number above 0.5 and up to 1, not 0.5"),
        ("--epsilon=2", "--epsilon: takes a number in the range [0.0, 1.0]"),
        ("--weighted_c=0", "--weighted_c: takes a number above 0, not 0"),
        ("--overwrite=3", "--overwrite: takes true or false"),
        ("--out=", "--out: takes a folder"),
        (f"--out={__file__}", f"--out={__file__}: takes a folder, which this is not"),
        ("--stepz=5", "--stepz: unknown flag; did you mean --steps?"),
        ("--flagfile=x", "--flagfile: unknown flag"),
        ("5", "5: unexpected argument"),
    ],
)
def test_a_wrong_flag_is_told_in_one_line_before_anything_runs(argument, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert tabular.main(["tabular", argument]) == 2
    told = capsys.readouterr()
    assert told.err.startswith(message) and told.err.count("\n") == 1 and not told.out
    assert not list(tmp_path.iterdir())


def test_help_names_every_flag(capsys):
    assert tabular.main(["tabular", "--help"]) == 0
    shown = capsys.readouterr().out
    assert all(f"--{name}" in shown or f"--[no]{name}" in shown for name in tabular.define_flags())


def test_checkpoints_lie_evenly_in_the_logarithm_and_end_with_the_last_step():
    for steps in (100, 101, 3000, 200_000):
        found = tabular.checkpoints(steps)
        assert found[0] == 100 and found[-1] == steps and (np.diff(found) > 0).all()
    ratios = np.diff(np.log(tabular.checkpoints(100_000)))
    assert ratios == pytest.approx(np.log(10) / 8, rel=0.02)
