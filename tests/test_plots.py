"""The plots command."""

import pytest
from made_runs import write_run
from matplotlib.image import imread

from experiments.plots import main


@pytest.fixture
def runs(tmp_path):
    write_run(tmp_path / "runs", "td3", curves=[[0, 5, 9], [0, 6, 8]])
    bias = {name: [[float("nan"), 2, 3]] * 4 for name in ("value_bias", "value_bias_normalised")}
    curves = [[0, 4, value] for value in (8, 9, 10, 12)]
    write_run(tmp_path / "runs", "td3_sqt", curves=curves, swept={"penalty_coef": (0.1, 0.5)}, more=bias)
    return tmp_path / "runs"


def test_every_figure_is_drawn_and_replaced_only_with_overwrite(runs, tmp_path, capsys):
    out = tmp_path / "figures"
    assert main(["plots", str(runs), f"--out={out}"]) == 0
    names = ["learning_curves", "q_std", "value_bias", "value_bias_normalised", "penalty_sweep", "performance_profile"]
    assert capsys.readouterr().out.split() == [str(out / f"{name}.png") for name in names]
    assert {path.name for path in out.iterdir()} == {f"{name}.png" for name in names}
    for path in out.iterdir():
        assert imread(path).std() > 0.05  # not blank
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert main(["plots", str(runs), f"--out={out}"]) == 2
    assert "learning_curves.png already exists" in capsys.readouterr().err
    assert main(["plots", str(runs), f"--out={out}", "--overwrite"]) == 0
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_figures_with_nothing_to_draw_are_named(runs, tmp_path, capsys):
    out = tmp_path / "figures"
    argv = ["plots", str(runs / "cheetah" / "td3"), f"--out={out}", "--format=svg", "--statistic=mean"]
    assert main(argv) == 0
    assert "nothing to draw: value_bias, penalty_sweep" in capsys.readouterr().err
    assert {path.name for path in out.iterdir()} == {"learning_curves.svg", "q_std.svg", "performance_profile.svg"}


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "RUNS: expects folders of runs"),
        (["runs", "--format=gif"], "--format: expects one of png, svg, pdf, not 'gif'"),
        (["runs", "--statistic=median"], "--statistic: expects one of iqm, mean, not 'median'"),
        (["runs", "--overwite"], "--overwite: unknown flag; did you mean --overwrite?"),
        (["none"], "none: does not exist"),
    ],
)
def test_an_invalid_command_is_one_line_and_writes_nothing(runs, tmp_path, monkeypatch, capsys, argv, message):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert main(["plots", *argv]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1 and not captured.out
    assert sorted(tmp_path.rglob("*")) == before
