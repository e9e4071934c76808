"""The report as a page: its parts, links, sort keys."""

from datetime import UTC, datetime

import pytest
from html_reader import Reader
from made_runs import write_run

from experiments.evidence import paper_tables
from experiments.evidence.cells import Cell
from experiments.evidence.page import make_content, page, sort_key
from experiments.evidence.pooling import collect


def content_of(folder, reference=False):
    runs = collect([str(folder)])
    content = make_content(runs, reference, "iqm", "python -m experiments.report runs")
    when = datetime(2026, 1, 2, 3, 4, tzinfo=UTC)
    return content._replace(tables=paper_tables.make_tables(runs, reference), made_at=when, made_by="sqt_jax 1.2.3")


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("4,275 ± 665 (5)", "4275"),
        ("+12.0 % [3.0, 20.0]", "+12.0"),
        ("P 0.67 [0.50, 0.90]", "0.67"),
        ("-0.05", "-0.05"),
        ("17 / 6", "17"),
        ("0.1, 0.5", "0.1"),
        ("-", ""),
        ("", ""),
        ("- (diverged)", None),
        ("0: 12.0  1: 13.0", None),
        ("published: td3, 10 seeds", None),
        ("2026-01-02T03:04:05+00:00", None),
        ("td3", None),
    ],
)
def test_sort_keys_of_cells(text, key):
    assert sort_key(Cell((text, "12.0 below"), (1,))) == key


def test_all_parts_are_in_order(tmp_path):
    write_run(tmp_path, "td3", curves=[[0, 5, 10], [0, 6, 11]])
    write_run(tmp_path, "td3_sqt", curves=[[0, 5, 12]])
    table = write_run(tmp_path, "sac") / "evaluations.csv"
    table.write_text(table.read_text().partition("\n")[0] + "\n")
    read = Reader(page(content_of(tmp_path)))
    text = " ".join(read.texts)
    pieces = [
        "sqt_jax report: td3, td3_sqt on cheetah",
        "Made 2026-01-02 03:04 UTC by sqt_jax 1.2.3",
        "2 runs of 2 algorithms (td3, td3_sqt) on 1 task (cheetah): 3 members with the seeds 0, 1.",
        "Planned: 100 environment steps per member; trained, over all members: 300.",
        "How the runs ended: 2 not ended.",
        "Some runs are incomplete",
        "Table 2: maximum average return",
        "Table 2, SQT variants against their baselines",
        "Table 3",
        "Seeds",
        "Figure 1: Return of an evaluation episode",
        "Nothing to draw for value_bias, penalty_sweep.",
        "Run 1: td3 on cheetah",
        "Run 2: td3_sqt on cheetah",
        "td3_sqt on cheetah: fewer seeds than other cells, which have 2",
        "sac/run has no evaluation yet",
    ]
    places = [text.rfind(piece) for piece in pieces]
    assert -1 not in places and places == sorted(places)
    assert read.tags.count("svg") == read.tags.count("figure") == 3


def test_footnotes_are_linked_and_ids_are_unique(tmp_path):
    write_run(tmp_path, "td3", curves=[[0, 5, 10], [0, 6, 11]])
    write_run(tmp_path, "td3_sqt", curves=[[0, 5, 12]])
    write_run(tmp_path, "td3_sqt_tuple", curves=[[0, 5, 12]])
    read = Reader(page(content_of(tmp_path, reference=True)))
    found = [value for name, value in read.attributes if name == "id"]
    links = [value for name, value in read.attributes if name == "href" and value.startswith("#")]
    labels = [value for name, value in read.attributes if name == "aria-labelledby"]
    assert len(set(found)) == len(found)
    assert {link[1:] for link in links} | {*labels} <= {*found}
    assert any("-note-" in link for link in links)


def test_a_complete_report_says_so(tmp_path):
    write_run(tmp_path, "td3", curves=[[0, 5, 10], [0, 6, 11]])
    text = page(content_of(tmp_path))
    assert "Every score covers all planned steps and seeds." in text and "Some runs" not in text


def test_many_names_are_counted_in_the_title(tmp_path):
    for algo in ("td3", "td3_sqt", "sac", "sac_sqt"):
        write_run(tmp_path, algo, curves=[[0, 5, 10]])
    assert "<title>sqt_jax report: 4 algorithms on cheetah</title>" in page(content_of(tmp_path))


def test_scores_and_the_comparisons_below_them_are_sorted_separately(tmp_path):
    for algo in ("td3", "td3_sqt", "td3_sqt_tuple"):
        write_run(tmp_path, algo, curves=[[0, 5, 10]])
    assert page(content_of(tmp_path)).count('class="apart"') == 1  # table 4
