"""The tables command."""

import csv
import subprocess
import sys

import pytest
from made_runs import write_run

from experiments.evidence.formats import FORMATS
from experiments.tables import NAMES, main


@pytest.fixture
def runs(tmp_path):
    for algo, level in [("td3", 10), ("td3_sqt", 12), ("td3_sqt_tuple", 11)]:
        write_run(tmp_path / "runs", algo, curves=[[0, level / 2, level + seed] for seed in range(3)])
    return tmp_path / "runs"


def test_all_tables_are_shown(runs, capsys):
    assert main(["tables", str(runs)]) == 0
    shown = capsys.readouterr().out
    for piece in (
        "Table 1: sizes",
        "Table 2: maximum",
        "SQT variants against their",
        "Table 3: dis",
        "Table 4: SQT",
        "Seeds",
    ):
        assert piece in shown
    assert "13.0 ± 0.82 (3)" in shown and "Humanoid-v4" in shown and "published" not in shown


@pytest.mark.parametrize("name", NAMES)
def test_every_format_is_shown(runs, capsys, name):
    assert main(["tables", str(runs), f"--format={name}", "--reference"]) == 0
    shown = capsys.readouterr().out
    assert "td3" in shown and "TD3 paper Table 1" in shown and "Gym v2" in shown
    sign = {"terminal": "─", "markdown": "|---|", "csv": "algo,row,env,quantity,", "latex": "\\begin{tabular}"}
    assert sign[name] in shown


def test_every_format_is_written_and_replaced_only_with_overwrite(runs, tmp_path, capsys):
    out = tmp_path / "tables"
    assert main(["tables", str(runs), f"--out={out}"]) == 0
    assert f"written to {out}: 7 tables" in capsys.readouterr().err
    names = ("table1", "table2", "table2_improvement", "table3", "table3_change", "table4", "seeds")
    assert {path.name for path in out.iterdir()} == {f"{n}.{suffix}" for n in names for suffix, _ in FORMATS.values()}
    with (out / "table2.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["algo"], row["mean"], row["per_seed"], row["steps"]) for row in rows] == [
        ("td3", "11.0", "10 11 12", "100"),
        ("td3_sqt", "13.0", "12 13 14", "100"),
        ("td3_sqt_tuple", "12.0", "11 12 13", "100"),
    ]
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    (out / "table4.tex").write_text("mine")
    assert main(["tables", str(runs), f"--out={out}"]) == 2
    assert "table1.txt already exists" in capsys.readouterr().err and (out / "table4.tex").read_text() == "mine"
    # The same table again, to the last digit: the bootstrap is seeded.
    assert main(["tables", str(runs), f"--out={out}", "--overwrite"]) == 0
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "RUNS: expects folders of runs"),
        (["none"], "none: does not exist"),
        (["runs", "--format=html"], "--format: expects one of terminal, markdown, csv, latex, not 'html'"),
        (["runs", "--referense"], "--referense: unknown flag; did you mean --reference?"),
        (["runs", "--out=runs/cheetah/td3/run/config.json"], "expects a folder, which this is not"),
    ],
)
def test_an_invalid_command_is_one_line_and_writes_nothing(runs, tmp_path, monkeypatch, capsys, argv, message):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert main(["tables", *argv]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1 and not captured.out
    assert sorted(tmp_path.rglob("*")) == before


def test_two_runs_with_the_same_seed_are_rejected(runs, capsys):
    write_run(runs / "again", "td3")
    assert main(["tables", str(runs)]) == 2
    assert "both have seed 0 of td3 on cheetah with the same settings" in capsys.readouterr().err


def test_a_typing_error_is_answered_without_jax():
    code = (
        "import sys; from experiments import tables, plots; from experiments.evidence import statistics; "
        "assert tables.main(['tables', 'x', '--no']) == plots.main(['plots', 'x', '--no']) == 2; "
        "assert not {'jax', 'matplotlib', 'scipy'} & {*sys.modules}"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
