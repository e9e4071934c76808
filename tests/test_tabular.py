"""The command from end to end."""

import pytest
from matplotlib.image import imread

from experiments import tabular
from experiments.theorem import study_flags


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
    assert capsys.readouterr().err == f"--out={out}: exists; expects another folder, or also --overwrite\n"
    settings, folder = study_flags.parse([*argv, f"--out={out}", "--overwrite"])
    assert (settings.coefs, settings.steps, folder) == ((0.0, 0.5), 400, out)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("--mdps=maze", "--mdps: expects one of random, chain, grid, not 'maze'"),
        ("--mdps=", "--mdps: expects at least one"),
        ("--algos=q_learning,sarsa", "--algos: expects one of q_learning, "),
        ("--coefs=0,-1", "--coefs: expects numbers of at least 0 like 0,0.5, not '-1'"),
        ("--coefs=nan", "--coefs: expects numbers of at least 0"),
        ("--coefs=0,0.0", "--coefs: expects each value once, got 0.0 2 times"),
        ("--seeds=0", "--seeds: expects an integer in the range [1, 10000]"),
        ("--seeds=many", "--seeds: expects an integer in the range [1, 10000]"),
        ("--steps=1", "--steps: expects an integer in the range [100, 100000000]"),
        ("--tables=1", "--tables: expects an integer in the range [2, 100]"),
        ("--greedy=max", "--greedy: expects one of min, mean, penalised, not 'max'"),
        ("--gamma=1", "--gamma: expects a number above 0 and below 1, not 1"),
        ("--gamma=0", "--gamma: expects a number above 0 and below 1, not 0"),
        ("--gamma=nan", "--gamma: expects a number"),
        ("--lr_power=0.5", "--lr_power: expects a number above 0.5 and up to 1, not 0.5"),
        ("--epsilon=2", "--epsilon: expects a number in the range [0.0, 1.0]"),
        ("--weighted_c=0", "--weighted_c: expects a number above 0, not 0"),
        ("--overwrite=3", "--overwrite: expects true or false"),
        ("--out=", "--out: expects a folder"),
        (f"--out={__file__}", f"--out={__file__}: expects a folder, which this is not"),
        (f"--out={__file__}/below", f"--out={__file__}/below: expects a folder that can be written"),
        ("--out=" + "x" * 300, f"--out={'x' * 300}: expects a folder that can be written"),
        ("--stepz=5", "--stepz: unknown flag; did you mean --steps?"),
        ("--flagfile=x", "--flagfile: unknown flag"),
        ("5", "5: unexpected argument"),
    ],
)
def test_a_wrong_flag_is_rejected_in_one_line_before_anything_runs(argument, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert tabular.main(["tabular", argument]) == 2
    shown = capsys.readouterr()
    assert shown.err.startswith(message) and shown.err.count("\n") == 1 and not shown.out
    assert not list(tmp_path.iterdir())


def test_a_folder_in_the_place_of_a_result_is_rejected_before_anything_runs(tmp_path, capsys):
    (tmp_path / "tabular.png").mkdir()
    assert tabular.main(["tabular", f"--out={tmp_path}", "--overwrite"]) == 2
    assert capsys.readouterr().err.startswith(f"--out={tmp_path}: tabular.png is a folder; expects a folder without it")


def test_help_names_every_flag(capsys):
    assert tabular.main(["tabular", "--help"]) == 0
    shown = capsys.readouterr().out
    assert all(f"--{name}" in shown or f"--[no]{name}" in shown for name in study_flags.define_flags())
