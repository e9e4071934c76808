"""The report command."""

import re
import subprocess
import sys

import pytest
from html_reader import Reader
from made_runs import HOSTILE, make_hostile, write_run

from experiments.report import main


@pytest.fixture
def runs(tmp_path):
    write_run(tmp_path / "runs", "td3", curves=[[0, 5, 9], [0, 6, 8]])
    curves = [[0, 4, value] for value in (8, 9, 10, 12)]
    write_run(tmp_path / "runs", "td3_sqt", curves=curves, swept={"penalty_coef": (0.1, 0.5)})
    return tmp_path / "runs"


def test_a_report_is_one_file_that_needs_no_other(runs, tmp_path, capsys):
    out = tmp_path / "new" / "report.html"
    assert main(["report", str(runs), f"--out={out}"]) == 0
    assert capsys.readouterr().out == f"{out}\n"
    assert [*out.parent.iterdir()] == [out]
    text = out.read_text(encoding="utf-8")
    for piece in ("Table 1: sizes", "Table 2: max", "Table 3: dis", "Figure 3: Score against penalty_coef", "Run 2:"):
        assert piece in text
    assert "TD3 paper Table 1" not in text
    read = Reader(text)
    assert not {*read.tags} & {"img", "iframe", "object", "embed", "image"}
    addresses = [value for name, value in read.attributes if name in ("src", "href", "xlink:href", "srcset")]
    assert {value for value in addresses if not value.startswith("#")} == {"data:,"}
    assert not re.search(r"@import|url\((?!#)", text)


def test_published_figures_with_reference(runs, tmp_path):
    out = tmp_path / "report.html"
    assert main(["report", str(runs), f"--out={out}", "--reference", "--statistic=mean"]) == 0
    assert "TD3 paper Table 1" in out.read_text() and "episode: mean over seeds" in out.read_text()


def test_a_report_is_replaced_only_with_overwrite(runs, tmp_path, capsys):
    out = tmp_path / "report.html"
    out.write_text("mine")
    assert main(["report", str(runs), f"--out={out}"]) == 2
    assert capsys.readouterr().err == (
        f"--out={out}: already exists; expects another file, or --overwrite replaces it\n"
    )
    assert out.read_text() == "mine"
    assert main(["report", str(runs), f"--out={out}", "--overwrite"]) == 0
    assert out.read_text().startswith("<!DOCTYPE html>")


def test_runs_that_were_left_out_are_named(runs, tmp_path, capsys):
    (runs / "cheetah" / "td3" / "run" / "config.json").unlink()
    assert main(["report", str(runs), f"--out={tmp_path / 'report.html'}"]) == 0
    assert "td3/run has an evaluations.csv but no config.json" in capsys.readouterr().err


def test_texts_of_a_run_are_never_markup(runs, tmp_path):
    make_hostile(write_run(runs, "sac", name="<script>alert(3)</script>".replace("/", "")))
    make_hostile(write_run(runs, "sac", name="other", seeds=[1]))
    write_run(runs, "sac", name="third", seeds=[2])  # of other versions: a footnote
    out = tmp_path / "report.html"
    assert main(["report", str(runs), f"--out={out}"]) == 0
    read = Reader(out.read_text(encoding="utf-8"))
    assert read.tags.count("script") == 1 and "img" not in read.tags
    assert not [name for name, _ in read.attributes if name.startswith("on") or name == "style"]
    assert "".join(read.texts).count(HOSTILE[:50]) > 10


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "RUNS: expects folders of runs or folders above them, as in python -m experiments.report"),
        (["none"], "none: does not exist"),
        (["runs", "--out="], "--out: expects a file"),
        (["runs", "--out=runs"], "--out=runs: expects a file, which this folder is not"),
        (["runs", "--out=runs/cheetah/td3/run/config.json/x"], "expects a file"),
        (["runs", "--statistic=median"], "--statistic: expects one of iqm, mean, not 'median'"),
        (["runs", "--referense"], "--referense: unknown flag; did you mean --reference?"),
    ],
)
def test_an_invalid_command_is_one_line_and_writes_nothing(runs, tmp_path, monkeypatch, capsys, argv, message):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert main(["report", *argv]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1 and not captured.out
    assert sorted(tmp_path.rglob("*")) == before


def test_a_typing_error_is_answered_without_jax():
    code = (
        "import sys; from experiments import report; assert report.main(['report', 'x', '--no']) == 2; "
        "assert not {'jax', 'matplotlib', 'scipy'} & {*sys.modules}"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
