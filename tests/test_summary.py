"""The rows and the legend of the tabular study."""

from pathlib import Path

from made_curves import curves

from experiments.theorem import summary


def test_the_committed_table_has_todays_legend():
    table = Path(summary.__file__).parent.parent / "results" / "tabular" / "table.md"
    assert "\n".join(summary.LEGEND) in table.read_text(encoding="utf-8")
    assert "there are many intervals is not corrected for" in table.read_text(encoding="utf-8")


def test_equal_rows_are_shown_as_one():
    found = summary.learning_rows({("grid", "sqt_shared"): curves((0.0, 0.5), 2), ("grid", "q_learning"): curves()})
    assert [row[:3] for row in found] == [("grid", "sqt_shared", "all alike"), ("grid", "q_learning", "-")]
    assert all(len(row) == len(summary.HEADER) for row in found)
