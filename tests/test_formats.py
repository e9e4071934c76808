"""Result tables as Markdown, CSV, LaTeX and text."""

import csv
import io
import re

import pytest
from rich.console import Console

from experiments.evidence.cells import Cell, Line, ResultTable
from experiments.evidence.formats import FORMATS, comma_separated, latex, markdown, rich_table, terminal

TABLE = ResultTable(
    "table2",
    "Table 2: scores",
    ["algorithm", "cheetah & co", "UTD"],
    [
        [Line([Cell(("td3_sqt (5 %)",)), Cell(("-4,275 ± 665 (5)", "4,312 [3,491, 5,002]"), (1, 2)), Cell(("1",))])],
        [Line([Cell(("published: td3|x",)), Cell(("",)), Cell(("-",))], published=True)],
    ],
    "What it is.",
    ["seed 3 diverged", "fewer seeds"],
    [{"algo": "td3_sqt", "mean": -4275.25, "std": None}, {"algo": "td3", "mean": float("nan"), "source": "a, b"}],
)


def test_markdown():
    assert markdown(TABLE) == (
        "### Table 2: scores\n\n"
        "| algorithm | cheetah & co | UTD |\n"
        "|---|---|---|\n"
        "| td3_sqt (5 %) | -4,275 ± 665 (5)<br>4,312 [3,491, 5,002] <sup>1,2</sup> | 1 |\n"
        "| *published: td3\\|x* |  | *-* |\n\n"
        "What it is.\n\n"
        "<sup>1</sup> seed 3 diverged  \n"
        "<sup>2</sup> fewer seeds\n"
    )


def test_csv_has_the_full_numbers_and_empty_fields_for_unknown_ones():
    assert comma_separated(TABLE) == 'algo,mean,std,source\ntd3_sqt,-4275.25,,\ntd3,,,"a, b"\n'
    assert len(list(csv.DictReader(io.StringIO(comma_separated(TABLE))))) == 2


def test_latex_escapes_and_balances():
    text = latex(TABLE)
    assert r"td3\_sqt (5 \%) & \shortstack[l]{$-$4,275 $\pm$ 665 (5) \\ 4,312 [3,491, 5,002]" in text
    assert r"\textsuperscript{1,2}} & 1 \\" in text and r"cheetah \& co" in text
    assert r"\textit{published: td3|x} &  & \textit{-} \\" in text
    assert text.count("{") == text.count("}")
    assert re.findall(r"\\(begin|end)\{(\w+)\}", text) == [
        ("begin", "table"),
        ("begin", "tabular"),
        ("end", "tabular"),
        ("end", "table"),
    ]


def test_terminal_has_everything():
    text = terminal(TABLE)
    for piece in (
        "Table 2: scores",
        "-4,275 ± 665 (5)",
        "4,312 [3,491, 5,002] (1,2)",
        "(2) fewer seeds",
        "What it is.",
    ):
        assert piece in text
    assert "\x1b" not in text


def test_a_narrow_terminal_cuts_no_number():
    stream = io.StringIO()
    Console(file=stream, width=40, color_system=None).print(rich_table(TABLE))
    for piece in ("-4,275", "665", "[3,491,", "5,002]"):
        assert piece in stream.getvalue()


@pytest.mark.parametrize("name", FORMATS)
def test_an_empty_table_can_be_written(name):
    assert FORMATS[name][1](TABLE._replace(sections=[], records=[], notes=[])).strip() or name == "csv"


def test_a_tasks_name_is_no_markup():
    table = TABLE._replace(header=["algorithm", "[/b]<i>|", "UTD"])
    assert "[/b]<i>|" in terminal(table)
    assert "| algorithm | [/b]&lt;i>\\| | UTD |" in markdown(table)
