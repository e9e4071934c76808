"""The report as a browser shows it: figures are visible, tables can be sorted, and nothing hostile runs."""

import browser
import pytest
from made_runs import make_hostile, write_run

from experiments.report import main

CHROMIUM = browser.find()
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason=f"no browser: none of {', '.join(browser.NAMES)} on the PATH")

# The texts of a table's column, each cell's first line without footnotes.
COLUMN = """(([table, header]) => {
  const found = document.getElementById(table).parentElement.querySelector("table");
  const index = [...found.tHead.rows[0].cells].findIndex((cell) => cell.textContent === header);
  const cells = [...found.querySelectorAll("tbody tr")].map((row) => row.cells[index]);
  return cells.map((cell) => cell.querySelector("span").firstChild?.textContent);
})"""
HEADER = """(([table, header]) =>
  [...document.getElementById(table).parentElement.querySelectorAll("th")].find((cell) => cell.textContent === header)
)"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    nan = float("nan")
    for env, level in (("cheetah", 12_000), ("walker", 3_000)):
        for place, algo in enumerate(("td3", "td3_sqt", "td3_sqt_tuple", "sac")):
            returns = [[0, level / 2, level - 2_000 * place + seed] for seed in range(3)]
            bias = {"value_bias": [[nan, 1, 2]] * 3}
            path = write_run(folder / "runs", algo, env, curves=returns, q_std=[0.5, 1, 2], more=bias)
            make_hostile(path)
    sweep = {"penalty_coef": (0.1, 1.0)}
    write_run(folder / "runs", "td3_sqt", curves=[[0, 1, 950], [0, 1, nan]], name="sweep", swept=sweep)
    out = folder / "report.html"
    assert main(["report", str(folder / "runs"), f"--out={out}", "--reference"]) == 0
    return out


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    with browser.opened(CHROMIUM, tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def page(opened, report):
    opened.resize(1280, 900)
    opened.set_scheme("light")
    opened.errors.clear()
    opened.requests.clear()
    opened.open(report.as_uri())
    yield opened
    assert opened.errors == []
    assert [*opened.requests.values()] == [report.as_uri()]


def test_every_figure_is_visible(page):
    boxes = page.run(
        """[...document.querySelectorAll("figure")].map((figure) => {
          const svg = figure.querySelector("svg");
          const lines = [...svg.querySelectorAll("path, use")].filter((e) => e.getBoundingClientRect().width > 0);
          return [svg.getBoundingClientRect().width, svg.getBoundingClientRect().height, lines.length];
        })"""
    )
    assert len(boxes) == 5
    assert all(width > 300 and height > 150 and lines > 50 for width, height, lines in boxes)


def test_glyphs_and_markers_are_those_of_their_own_figure(page):
    assert page.run(
        """[...document.querySelectorAll("svg use")].every((use) => {
          const target = document.getElementById(use.getAttribute("href").slice(1));
          return target && target.closest("svg") === use.closest("svg");
        })"""
    )


def test_a_click_sorts_ascending_then_descending_then_not(page):
    place = ["table-table2", "walker"]

    def state():
        return page.run(f"{HEADER}({place}).ariaSort"), page.run(f"{COLUMN}({place})")

    def numbers(texts):
        return [float(text.split(" ")[0].replace(",", "")) for text in texts if text != "-"]

    kind, before = state()
    assert kind == "none" and numbers(before) != sorted(numbers(before)) and before[-1] != "-"
    page.run(f"{HEADER}({place}).querySelector('button').click()")
    kind, up = state()
    assert kind == "ascending" and numbers(up) == sorted(numbers(before))
    assert sorted(up) == sorted(before) and up[-1] == "-"  # none is lost, and empty cells stay last
    page.run(f"{HEADER}({place}).querySelector('button').click()")
    kind, down = state()
    assert kind == "descending" and numbers(down) == numbers(up)[::-1] and down[-1] == "-"
    page.run(f"{HEADER}({place}).querySelector('button').click()")
    assert state() == ("none", before)


def test_words_are_sorted_and_another_header_replaces_the_first(page):
    table = "table-seeds"
    page.run(f"{HEADER}({[table, 'task']}).querySelector('button').click()")
    tasks = page.run(f"{COLUMN}({[table, 'task']})")
    assert tasks == sorted(tasks) and {*tasks} == {"cheetah", "walker"}
    page.run(f"{HEADER}({[table, 'algorithm']}).querySelector('button').click()")
    assert page.run(f"{HEADER}({[table, 'task']}).ariaSort") == "none"
    algos = page.run(f"{COLUMN}({[table, 'algorithm']})")
    assert algos == sorted(algos) and len({*algos}) == 6


def test_comparisons_stay_below_the_scores(page):
    page.run(f"{HEADER}({['table-table4', 'cheetah']}).querySelector('button').click()")
    labels = page.run(f"{COLUMN}({['table-table4', 'algorithm']})")
    against = [" against " in label for label in labels]
    assert any(against) and against == sorted(against)


def test_keys_reach_and_work_the_headers(page):
    page.run(f"{HEADER}({['table-table1', 'observation']}).querySelector('button').focus()")
    page.press("Tab")
    assert page.run("document.activeElement.textContent") == "action"
    page.press("Enter", "\r")
    assert page.run(f"{COLUMN}({['table-table1', 'action']})") == ["6", "6", "8", "17"]


def test_nothing_hostile_has_run(page):
    assert page.run("[document.scripts.length, document.images.length]") == [1, 0]
    # Even as markup it would not run: the page's policy forbids it.
    image = "<img src=x onerror='window.hacked = 1' style='color: red'>"
    page.run(f'document.body.insertAdjacentHTML("beforeend", "{image}")')
    page.run("document.body.append(Object.assign(document.createElement('script'), {textContent: 'hacked = 1'}))")
    page.run("new Promise((done) => setTimeout(done, 100))")
    assert page.run("window.hacked") is None
    assert page.errors and all("Content Security Policy" in error for error in page.errors)
    page.errors.clear()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_enough_contrast(page, scheme):
    page.set_scheme(scheme)
    text, ground = page.run("[getComputedStyle(document.body).color, getComputedStyle(document.body).backgroundColor]")

    def light(colour):
        return sum(map(int, colour.removeprefix("rgb(").removesuffix(")").split(", "))) / 765

    assert light(ground) - light(text) > 0.7 if scheme == "light" else light(text) - light(ground) > 0.7


@pytest.mark.parametrize("width", [360, 768, 1280])
def test_the_page_is_no_wider_than_the_screen(page, width):
    page.resize(width, 800)
    assert page.run("document.documentElement.scrollWidth") <= width


def test_commands_can_be_copied(page):
    assert page.run("document.querySelectorAll('pre + button').length === document.querySelectorAll('pre').length")
    page.run("document.querySelector('pre + button').click()")
    assert page.run("getSelection().toString()").startswith("python -m experiments.report")


def test_the_page_prints_completely(page):
    assert len(page.pdf()) > 100_000
