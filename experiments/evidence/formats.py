"""`cells.ResultTable` as terminal output, markdown, CSV and LaTeX."""

import csv
import io
import re
import sys
from collections.abc import Callable, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from experiments.evidence.cells import Cell, ResultTable
from experiments.surroundings.consoles import UNLIMITED, console

LATEX = {
    "\\": r"\textbackslash{}",
    "±": r"$\pm$",
    "×": r"$\times$",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
} | {character: f"\\{character}" for character in "&%$#_{}"}


def rich_table(table: ResultTable) -> Group:
    """The table with its caption and notes, for a rich console."""
    below = [Text(table.caption, style="italic")]
    below += [Text(f"({index}) {note}") for index, note in enumerate(table.notes, 1)]
    return Group(_grid(table), *(Padding(text, (0, 2)) for text in below), Text(""))


def _grid(table: ResultTable) -> Table:
    shown = Table(box=SIMPLE_HEAD, title=table.title, title_justify="left", title_style="bold")
    for name in table.header:
        shown.add_column(Text(name), overflow="fold")
    for lines in table.sections:
        for line in lines:
            shown.add_row(*(Text(_plain(cell)) for cell in line.cells), style="dim" if line.published else "")
        shown.add_section()
    return shown


def terminal(table: ResultTable, width: int = 200) -> str:
    """The table as plain text, for a file or a pipe: the table as wide as it needs, the notes in lines of `width`."""
    needed = Console(width=UNLIMITED).measure(_grid(table)).maximum
    stream = io.StringIO()
    Console(file=stream, width=max(width, needed), color_system=None).print(rich_table(table))
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()) + "\n"


def markdown(table: ResultTable) -> str:
    """The table as Markdown, with footnotes as superscripts."""

    def words(text: str) -> str:
        return text.replace("|", "\\|").replace("<", "&lt;")

    def text(cell: Cell) -> str:
        lines = "<br>".join(map(words, cell.lines))
        return lines + (f" <sup>{_marks(cell)}</sup>" if cell.marks else "")

    rows = [f"### {table.title}", "", f"| {' | '.join(map(words, table.header))} |", "|---" * len(table.header) + "|"]
    for lines in table.sections:
        for line in lines:
            cells = [text(cell) for cell in line.cells]
            rows.append(f"| {' | '.join(f'*{c}*' if line.published and c else c for c in cells)} |")
    rows += ["", table.caption, ""]
    rows += [f"<sup>{index}</sup> {note}  " for index, note in enumerate(table.notes, 1)]
    return "\n".join(rows).rstrip() + "\n"


def comma_separated(table: ResultTable) -> str:
    """The unrounded numbers as CSV: a row per cell, not per row of the table."""
    columns = dict.fromkeys(name for record in table.records for name in record)
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(columns), restval="", lineterminator="\n")
    writer.writeheader()
    for record in table.records:
        writer.writerow({name: "" if value is None or value != value else value for name, value in record.items()})
    return stream.getvalue()


def latex(table: ResultTable) -> str:
    """A LaTeX `table` with a `tabular`; it needs no package."""

    def text(cell: Cell) -> str:
        marks = f"\\textsuperscript{{{_marks(cell)}}}" if cell.marks else ""
        lines = [_escaped(line) for line in cell.lines]
        lines[-1] += marks
        together = r" \\ ".join(lines)
        return together if len(lines) == 1 else f"\\shortstack[l]{{{together}}}"

    rows = [
        r"\begin{table}",
        r"\centering",
        r"\footnotesize",
        f"\\caption{{{_escaped(table.title)}. {_escaped(table.caption)}}}",
        f"\\begin{{tabular}}{{{'l' * len(table.header)}}}",
        r"\hline",
        " & ".join(map(_escaped, table.header)) + r" \\",
    ]
    for lines in table.sections:
        rows.append(r"\hline")
        for line in lines:
            cells = [text(cell) for cell in line.cells]
            rows.append(" & ".join(f"\\textit{{{c}}}" if line.published and c else c for c in cells) + r" \\")
    rows += [r"\hline", r"\end{tabular}"]
    for index, note in enumerate(table.notes, 1):
        rows += ["", f"\\noindent\\textsuperscript{{{index}}} {_escaped(note)}"]
    return "\n".join([*rows, r"\end{table}"]) + "\n"


FORMATS: dict[str, tuple[str, Callable[[ResultTable], str]]] = {
    "terminal": ("txt", terminal),
    "markdown": ("md", markdown),
    "csv": ("csv", comma_separated),
    "latex": ("tex", latex),
}


def file_names(tables: Sequence[str]) -> list[str]:
    """The names of all files of the named tables, one per format."""
    return [f"{name}.{suffix}" for name in tables for suffix, _ in FORMATS.values()]


def file_contents(tables: Sequence[ResultTable]) -> dict[str, bytes]:
    """The tables in all formats, by file name."""
    return {f"{table.name}.{suffix}": write(table).encode() for table in tables for suffix, write in FORMATS.values()}


def show(tables: Sequence[ResultTable], name: str) -> None:
    """Prints the tables in a format of `FORMATS`; on a terminal, `terminal` has its width and styles."""
    if name == "terminal" and sys.stdout.isatty():
        for table in tables:
            console().print(rich_table(table))
    else:
        print("\n".join(FORMATS[name][1](table) for table in tables), end="")


def _plain(cell: Cell) -> str:
    text = "\n".join(cell.lines)
    return f"{text} ({_marks(cell)})" if cell.marks else text


def _marks(cell: Cell) -> str:
    return ",".join(map(str, cell.marks))


def _escaped(text: str) -> str:
    text = "".join(LATEX.get(character, character) for character in text)
    return re.sub(r"(?<![\w-])-(?=\d)", "$-$", text)
