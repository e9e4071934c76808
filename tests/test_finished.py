"""Which runs are finished, and their scores."""

import json
from pathlib import Path

import pytest

from experiments.grids.finished import finished, scores
from experiments.launchers.cell import Cell

DONE = {"status": "done", "diverged": [], "groups": [{"score": {"mean": 1234.5, "std": 6.0}}]}


@pytest.fixture
def written(tmp_path):
    """A cell whose run has this summary."""

    def write(text):
        (tmp_path / "summary.json").write_text(text)
        return Cell("ant", "td3", tmp_path, ())

    return write


def test_a_finished_run_has_scores(written):
    assert scores(finished(written(json.dumps(DONE)))) == "score 1,234 +- 6"
    two = DONE | {"status": "diverged", "diverged": [{}], "groups": [*DONE["groups"], {"score": {"mean": None}}]}
    assert scores(finished(written(json.dumps(two)))) == "score 1,234 +- 6, none (1 diverged)"


@pytest.mark.parametrize(
    "text",
    ["", "[]", '{"status": "done"}', *(json.dumps(DONE | {"groups": groups}) for groups in ([{}], 1, [1]))]
    + [json.dumps(DONE | wrong) for wrong in ({"status": "running"}, {"diverged": 1})]
    + [json.dumps(DONE | {"groups": [{"score": {"mean": "5", "std": 1.0}}]})],
)
def test_a_damaged_summary_is_not_that_of_a_finished_run(written, text):
    assert finished(written(text)) is None


def test_a_run_without_a_summary_is_not_finished():
    assert finished(Cell("ant", "td3", Path("none"), ())) is None
