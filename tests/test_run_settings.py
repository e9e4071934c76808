"""Runs of algorithms that this version does not know."""

import json

import pytest
from made_runs import write_run

from experiments import plots, report, tables
from experiments.commandline.arguments import UsageError
from experiments.evidence.pooling import collect
from experiments.evidence.run_settings import read


def rename(path, algo="td9_sqt", **settings):
    """Makes a run one of another algorithm."""
    content = json.loads((path / "config.json").read_text())
    content["settings"] |= {"algo": algo} | settings
    (path / "config.json").write_text(json.dumps(content))
    return path


@pytest.fixture
def runs(tmp_path):
    write_run(tmp_path / "runs", "td3", curves=[[0, 5, 9], [0, 6, 8]])
    sweep = {"penalty_coef": (0.1, 0.5)}
    path = write_run(tmp_path / "runs", "td3_sqt", curves=[[0, 4, v] for v in (8, 9, 10, 12)], swept=sweep)
    rename(path, penalty="of a newer version", new_setting=[1, 2])
    return tmp_path / "runs"


def test_runs_of_an_unknown_algorithm_are_pooled_by_their_settings(runs):
    td3, low, high = collect([str(runs)]).groups
    assert (td3.algo, low.algo, high.algo) == ("td3", "td9_sqt", "td9_sqt")
    assert (low.settings["penalty_coef"], high.settings["penalty_coef"]) == (0.1, 0.5) and low.seeds == (0, 1)
    assert low.settings["new_setting"] == (1, 2)


def test_every_command_shows_an_unknown_algorithm(runs, tmp_path, capsys):
    assert tables.main(["tables", str(runs), f"--out={tmp_path / 'tables'}", "--reference"]) == 0
    shown = capsys.readouterr().out
    assert "td9_sqt (penalty_coef 0.5)" in shown and "td9_sqt against" not in shown and "0.5) against" not in shown
    assert plots.main(["plots", str(runs), f"--out={tmp_path / 'figures'}"]) == 0
    assert report.main(["report", str(runs), f"--out={tmp_path / 'report.html'}"]) == 0
    assert "td9_sqt on cheetah" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    "damage",
    [
        {"algo": 3},
        {"steps": "many"},
        {"physics": None},
        {"env": "\x1b[0m"},
        {"penalty": "x" * 200},
        {"lr": float("inf")},
    ],
)
def test_damaged_settings_of_an_unknown_algorithm_are_rejected(tmp_path, damage):
    path = rename(write_run(tmp_path), **damage)
    with pytest.raises(UsageError, match=r"config\.json"):
        read(path)


def test_a_known_algorithm_with_a_wrong_setting_is_rejected(tmp_path):
    with pytest.raises(UsageError, match="has an invalid setting"):
        read(rename(write_run(tmp_path), "td3", steps=-1))
