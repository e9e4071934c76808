"""The report as one page: a summary, tables, figures, details of each run, and incomplete scores."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

from matplotlib.figure import Figure

from experiments.evidence import figures, paper_tables, run_details, task_sizes
from experiments.evidence.cells import NOTHING, Cell, ResultTable
from experiments.evidence.markup import document, element, inline_svg
from experiments.evidence.pooling import Collected
from experiments.evidence.run_details import Command, Details
from experiments.running import run_config

FOLDER = Path(__file__).parent / "data" / "report"
LONG = 45  # cells with more characters may be wrapped
# `4,275 ± 665 (5)`, `+12.0 % [3.0, 20.0]`, `P 0.67 [0.50, 0.90]`, `17 / 6`; not `0: 12.0  1: 13.0`.
NUMBER = re.compile(r"(?:P )?([+-]?\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?)(?![^\s,%])")


OF_WHICH_POLICY = (
    "The final return is that of the last evaluation, whose policy experiments.play plays. The best return is a "
    "maximum over all evaluations, hence optimistic; --policy=best plays its policy, if the run has kept it."
)
ALL_COMPLETE = "Every score covers all planned steps and seeds."


class Content(NamedTuple):
    """The contents of a page."""

    runs: Collected
    tables: Sequence[ResultTable]
    figures: Mapping[str, Figure | None]  # None: nothing to draw
    details: Sequence[Details]
    made_at: datetime
    made_by: str  # the package and its version
    command: str


def make_content(runs: Collected, reference: bool, statistic: str, command: str) -> Content:
    """The contents of a page on `runs`, made now.

    Args:
      reference: with published numbers.
      statistic: of the figures, `iqm` or `mean`.
      command: the command line that is shown.

    Raises:
      UsageError: a run's config.json cannot be read or is damaged.
    """
    return Content(
        runs=runs,
        tables=paper_tables.make_tables(runs, reference, task_sizes.read_sizes(runs)),
        figures={name: draw() for name, draw in figures.all_figures(runs, statistic).items()},
        details=run_details.read_all(runs),
        made_at=datetime.now(UTC),
        made_by=f"sqt_jax {run_config.versions()['sqt_jax'] or 'of an unknown version'}",
        command=command,
    )


def page(content: Content) -> str:
    """The report as HTML that needs no other file."""
    algos, tasks = _unique(run.algo for run in content.details), _unique(run.env for run in content.details)
    title = f"sqt_jax report: {_few(algos, 'algorithm')} on {_few(tasks, 'task')}"
    sections = {
        "Tables": [_table(table) for table in content.tables],
        "Figures": _figures(content.figures),
        "Runs": [_overview(content.details), *(_run(i, run) for i, run in enumerate(content.details, 1))],
        "Incomplete": [_incomplete(content)],
    }
    links = [element("li", element("a", name, href=f"#{_id(name)}")) for name in sections]
    header = element(
        "header",
        element("h1", title),
        element("p", f"Made {content.made_at:%Y-%m-%d %H:%M} UTC by {content.made_by}: ", class_="faint"),
        element("pre", element("code", content.command)),
        element("p", *_summary(content)),
        element("nav", element("ul", *links), aria_label="Contents"),
    )
    parts = [
        element("section", element("h2", name, id=_id(name)), *children, aria_labelledby=_id(name))
        for name, children in sections.items()
    ]
    style, script = ((FOLDER / f"report.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    return document(title, style, script, header, element("main", *parts))


def sort_key(cell: Cell) -> str | None:
    """The number that a cell is sorted by, "" for an empty cell, None for words."""
    if cell.lines[0] in ("", NOTHING):
        return ""
    found = NUMBER.match(cell.lines[0])
    return found[1].replace(",", "") if found else None


def _summary(content: Content) -> list[str | Element]:
    details, groups = content.details, content.runs.groups
    algos, tasks = _unique(run.algo for run in details), _unique(run.env for run in details)
    curves = [member for group in groups for member in group.members]
    seeds = sorted({member.seed for member in curves})
    planned = sorted({run.steps for run in details})
    trained = sum(int(member.columns["env_steps"][-1]) for member in curves)
    status = Counter(run.status.partition(":")[0] for run in details)
    steps = f"{planned[0]:,}" if len(planned) == 1 else f"{planned[0]:,} to {planned[-1]:,}"
    text = (
        f"{_count(len(details), 'run')} of {_count(len(algos), 'algorithm')} ({_list(algos)}) on "
        f"{_count(len(tasks), 'task')} ({_list(tasks)}): {_count(len(curves), 'member')} with the seeds "
        f"{_list(map(str, seeds))}. Planned: {steps} environment steps per member; trained, over all members: "
        f"{trained:,}. How the runs ended: {_list(f'{n} {name}' for name, n in status.items())}."
    )
    if not _not_complete(content):
        return [f"{text} {ALL_COMPLETE}"]
    link = element("a", "details", href=f"#{_id('Incomplete')}")
    return [f"{text} ", element("strong", "Some runs are incomplete", class_="incomplete"), ": ", link, "."]


def _table(table: ResultTable) -> Element:
    """A table with its caption and footnotes."""
    name = f"table-{table.name}"
    body = []
    for lines in table.sections:
        rows = [_row(line.cells, "published" if line.published else None, name) for line in lines]
        # The comparisons below the scores of table 4 are sorted separately.
        apart = len(table.sections) > 1 and " against " in lines[0].cells[0].lines[0]
        body.append(element("tbody", *rows, class_="apart" if apart else None))
    notes = [element("li", note, id=f"{name}-note-{index}") for index, note in enumerate(table.notes, 1)]
    return element(
        "section",
        element("h3", table.title, id=name),
        _scrolled(_sortable(table.header, body)),
        element("p", table.caption, class_="caption"),
        *([element("ol", *notes, class_="notes")] if notes else []),
    )


def _sortable(header: Sequence[str], body: Sequence[Element]) -> Element:
    heads = [element("th", name, scope="col", class_=_width(name)) for name in header]
    return element("table", element("thead", element("tr", *heads)), *body, class_="sortable")


def _row(cells: Sequence[Cell], kind: str | None = None, name: str = "", link: str = "") -> Element:
    """A row whose first cell is its header, optionally with a `link`. `name`: of the table, for links to footnotes."""
    made = []
    for index, cell in enumerate(cells):
        first = cell.lines[0] if index or not link else element("a", cell.lines[0], href=link)
        lines = [element("span", first), *(element("span", line) for line in cell.lines[1:])]
        if cell.marks:
            links: list[str | Element] = []
            for mark in cell.marks:
                links += ["," if links else "", element("a", str(mark), href=f"#{name}-note-{mark}")]
            lines[-1].append(element("sup", *links))
        key = sort_key(cell)
        tag, scope = ("td", None) if index else ("th", "row")
        made.append(element(tag, *lines, scope=scope, class_=_width(max(cell.lines, key=len)), data_sort=key))
    return element("tr", *made, class_=kind)


def _figures(drawn: Mapping[str, Figure | None]) -> list[Element]:
    found = [figure for figure in drawn.values() if figure]
    made = [_figure(index, figure) for index, figure in enumerate(found, 1)]
    missing = [name for name, figure in drawn.items() if not figure]
    if missing:
        made.append(element("p", f"Nothing to draw for {_list(missing)}.", class_="faint"))
    return made


def _figure(index: int, figure: Figure) -> Element:
    """A figure with its heading as an HTML caption, which wraps and can be searched and read aloud."""
    name = f"figure-{index}"
    heading = " ".join(figure.get_suptitle().split())
    figure.suptitle("")
    picture = inline_svg(figures.image(figure, "svg"), f"{name}-", name)
    caption = element("figcaption", f"Figure {index}: {heading}.", id=name)
    return element("figure", _scrolled(picture), caption)


def _overview(details: Sequence[Details]) -> Element:
    header = ["run", "algorithm", "task", "seeds", "steps", "physics", "status", "took", "began"]
    rows = []
    for index, run in enumerate(details, 1):
        words = [str(index), run.algo, run.env, _list(map(str, run.seeds)), f"{run.steps:,}", run.physics, run.status]
        words += [run.facts.get("took", NOTHING), run.facts["began"]]
        # Lists of seeds and dates begin with a digit but are not numbers.
        rows.append(_row([Cell((word,)) for word in words], link=f"#run-{index}"))
        for place in (header.index("seeds"), header.index("began")):
            rows[-1][place].attrib.pop("data-sort", None)
    return _scrolled(_sortable(header, [element("tbody", *rows)]))


def _run(index: int, run: Details) -> Element:
    name = f"run-{index}"
    pairs = {"folder": str(run.path), "status": run.status, "steps per member": f"{run.steps:,}"}
    pairs |= {"physics": run.physics, "seeds": _list(map(str, run.seeds))} | run.facts
    settings = [
        _row([Cell((setting.name,)), Cell((setting.value,)), Cell((setting.default,))]) for setting in run.settings
    ]
    members = [
        _row([Cell((word,)) for word in (str(m.seed), *m.swept, m.env_steps, m.final, m.best, m.best_env_steps)])
        for m in run.members
    ]
    columns = ["seed", *run.swept, "steps done", "final return", "best return", "at step"]

    def part(title: str, *children: Element) -> list[Element]:
        return [element("h4", title), *children]

    def table(header: Sequence[str], rows: Sequence[Element]) -> Element:
        return _scrolled(_sortable(header, [element("tbody", *rows)]))

    none = element("p", "None.", class_="faint")
    return element(
        "details",
        element("summary", f"Run {index}: {run.algo} on {run.env}, {run.status}", id=name),
        *part("Commands that repeat it", *(piece for command in run.commands for piece in _command(command))),
        *part("Overview", _pairs(pairs)),
        *part("Members", table(columns, members), element("p", OF_WHICH_POLICY, class_="caption")),
        *part(
            f"Settings that differ from {run.algo}'s defaults",
            table(["setting", "here", "default"], settings) if settings else none,
        ),
        *part("Versions at its start", _pairs(run.versions)),
        open="",
    )


def _command(command: Command) -> list[Element]:
    made = [element("p", f"{command.label}:", class_="faint")]
    made += [element("pre", element("code", command.text))] if command.text is not None else []
    return made + ([element("p", command.note, class_="incomplete")] if command.note else [])


def _incomplete(content: Content) -> Element:
    lines = _not_complete(content)
    if not lines:
        return element("p", f"Nothing. {ALL_COMPLETE}")
    return element("ul", *(element("li", line) for line in lines))


def _not_complete(content: Content) -> list[str]:
    """The footnotes of incomplete scores, a line per cell, and the runs that were left out."""
    records: list[dict[str, Any]] = [r for table in content.tables if table.name == "table2" for r in table.records]
    cells = [f"{r['row']} on {r['env']}: {r['notes']}" for r in records if r["notes"] and not r["source"]]
    return [*cells, *content.runs.notes]


def _pairs(pairs: Mapping[str, str]) -> Element:
    return element(
        "dl", *(element(tag, text) for pair in pairs.items() for tag, text in zip(("dt", "dd"), pair, strict=True))
    )


def _scrolled(child: Element) -> Element:
    """A box that scrolls where its child is wider than the page."""
    return element("div", child, class_="scroll")


def _width(text: str) -> str | None:
    return "long" if len(text) > LONG else None


def _id(name: str) -> str:
    return name.lower().replace(" ", "-")


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _few(values: Sequence[str], noun: str) -> str:
    return _list(values) if len(values) < 4 else _count(len(values), noun)


def _unique(values: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(values))


def _list(values: Iterable[str]) -> str:
    return ", ".join(values)
