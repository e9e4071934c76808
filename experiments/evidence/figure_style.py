"""Shared by all figures: colours, line styles and markers, panels, legends and footnotes."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator

from experiments.evidence import statistics
from experiments.evidence.pooling import AlgorithmRow
from experiments.evidence.variants import BATCH_STD, TRANSITION_STD, baseline_of, variant_with, variants_of
from sqt_jax.algorithms import ALGORITHMS

# Figures look the same whatever the user's rc files and notebook say. `svg.hashsalt`: ids in SVG files are not random;
# `text.parse_math`: a dollar sign in a run's files starts no formula.
STYLE = ("default", {"svg.hashsalt": "sqt_jax", "text.parse_math": False})
in_our_style = matplotlib.style.context(list(STYLE))  # a decorator of functions that make or draw figures
# Okabe and Ito's palette, whose colours colour-blind readers can tell apart; without black and yellow.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LINES = ("-", "--", ":")
# A hue per baseline: dark for the baseline itself, full for SQT, light for SQT-tuple. Line styles carry the same
# information without colours.
HUES = {
    "td3": ("#00395C", "#0072B2", "#5FB3E6"),
    "sac": ("#7A3000", "#D55E00", "#F7A061"),
    "td7": ("#004D39", "#009E73", "#63D1AF"),
    "maxmin": ("#713A58", "#CC79A7", "#E8BFD5"),
    "redq": ("#7A5400", "#E69F00", "#FFCF66"),
}
GREYS = ("#333333", "#666666", "#999999")  # of other baselines
BASELINE_LINE = "-"
PENALTY_LINES: dict[str, Any] = {BATCH_STD: (0, (5, 1.5)), TRANSITION_STD: (0, (1, 1.2))}
# Of further SQT variants of a baseline, in the order of their rows.
FURTHER_LINES: tuple[Any, ...] = (
    (0, (6, 1.5, 1, 1.5)),
    (0, (6, 1.5, 1, 1.5, 1, 1.5)),
    (0, (9, 2)),
    (0, (3, 1, 3, 1, 1, 1)),
    (0, (2, 2)),
)
STATISTICS = {"iqm": statistics.iqm, "mean": statistics.mean}
NAMES = {"iqm": "interquartile mean", "mean": "mean"}
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
# With more lines than this, a figure has a row of panels per baseline instead of one for all.
MAX_LINES = 6


class Style(NamedTuple):
    """Colour, line and marker of a row."""

    colour: str
    line: Any  # one of matplotlib's line styles
    marker: str


class Panel(NamedTuple):
    """One pair of axes: some rows on one task."""

    part: int  # a part is a baseline with its SQT variants, or all rows; it has one legend
    rows: tuple[AlgorithmRow, ...]
    task: str
    axes: Axes


def algorithm_style(algo: str) -> tuple[str, Any]:
    """An algorithm's colour and line style, the same in every figure: its baseline's hue, and a line of its own.

    A further SQT variant, whose penalty is neither SQT's nor SQT-tuple's, has the baseline's colour.
    """
    baseline = baseline_of(algo)
    dark, full, light = HUES.get(baseline, GREYS)
    if algo == baseline:
        return dark, BASELINE_LINE
    for penalty, colour in ((BATCH_STD, full), (TRANSITION_STD, light)):
        if algo == variant_with(baseline, penalty):
            return colour, PENALTY_LINES[penalty]
    of_paper = {variant_with(baseline, penalty) for penalty in PENALTY_LINES}
    further = [name for name in variants_of(baseline) if name not in of_paper]
    return dark, FURTHER_LINES[further.index(algo) % len(FURTHER_LINES)]


ALGORITHM_COLOURS = {algo: algorithm_style(algo)[0] for algo in ALGORITHMS}


def styles(rows: Sequence[AlgorithmRow]) -> dict[str, Style]:
    """The style of each row by its label: its algorithm's; several rows of one algorithm are shades of its colour."""
    found = {}
    for algo in dict.fromkeys(row.algo for row in rows):
        own = [row.label for row in rows if row.algo == algo]
        colour, line = algorithm_style(algo)
        shades = np.linspace(0.4, -0.65, len(own)) if len(own) > 1 else [0.0]
        for index, (label, shade) in enumerate(zip(own, shades, strict=True)):
            marker = MARKERS[index % len(MARKERS)] if len(own) > 1 else ""
            found[label] = Style(_shade(colour, float(shade)), line, marker)
    return found


class Stars:
    """Footnotes of a figure: a row with an incomplete group has a star in the legend."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.labels: set[str] = set()

    def add(self, label: str, where: str, notes: Sequence[str]) -> None:
        """Adds the notes of a row, each once; `where` names the cell."""
        for note in notes:
            self.labels.add(label)
            if f"* {where}: {note}" not in self.texts:
                self.texts.append(f"* {where}: {note}")

    def starred(self, label: str) -> str:
        """The row's label, with a star if it has notes."""
        return f"{label} *" if label in self.labels else label

    def lines(self, width: int, most: int = 8) -> list[str]:
        """The first `most` notes, wrapped to `width` characters."""
        shown = [line for text in self.texts[:most] for line in textwrap.wrap(text, width)]
        return shown + ([f"... and {len(self.texts) - most} more"] if len(self.texts) > most else [])


def make_panels(rows: Sequence[AlgorithmRow], tasks: Sequence[str]) -> tuple[Figure, list[Panel]]:
    """A figure with a panel per task; with more than `MAX_LINES` rows, each baseline has its own row of panels."""
    parts = [tuple(rows)]
    if len(rows) > MAX_LINES:
        names = dict.fromkeys(baseline_of(row.algo) for row in rows)
        parts = [tuple(row for row in rows if baseline_of(row.algo) == name) for name in names]
    together = len(parts) == 1  # then the tasks are wrapped after four
    columns = min(len(tasks), 4) if together else len(tasks) if len(tasks) > 1 else len(parts)
    places = [(part, task) for part in range(len(parts)) for task in tasks]
    count = -(-len(places) // columns)
    size = (2.6 + 3.6 * columns, 0.9 + 2.8 * count) if count > 1 or together else (1 + 3.9 * columns, 5.2)
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    grid = figure.subplots(count, columns, squeeze=False)
    panels = []
    for index, axes in enumerate(grid.flat):
        if index >= len(places):
            axes.set_visible(False)
            continue
        part, task = places[index]
        panels.append(Panel(part=part, rows=parts[part], task=task, axes=axes))
        if part:  # the panels of a task have one scale
            axes.sharex(panels[tasks.index(task)].axes)
            axes.sharey(panels[tasks.index(task)].axes)
        if not part or len(tasks) == 1:
            axes.set_title(task, fontsize="medium")
    return figure, panels


def add_texts(
    figure: Figure,
    panels: Sequence[Panel],
    style: Mapping[str, Style],
    stars: Stars,
    heading: str,
    x_label: str,
    y_label: str,
) -> None:
    """Adds the legends, one per part, the heading, the labels and the footnotes."""
    last = {panel.part: panel for panel in panels}
    for panel in last.values():
        handles = [handle(style[row.label], stars.starred(row.label), style[row.label].marker) for row in panel.rows]
        kind: dict[str, Any] = {"handles": handles, "frameon": False, "fontsize": "small", "handlelength": 3}
        if len(last) == 1:
            figure.legend(loc="outside right center", **kind)
        elif len(last) == len(panels):  # one task: a row of panels, one per part
            panel.axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), **kind)
        else:
            panel.axes.legend(loc="center left", bbox_to_anchor=(1.02, 0.5), **kind)
    figure.suptitle(wrapped(figure, heading), fontsize="medium")
    width = int(figure.get_figwidth() * 13)
    figure.supxlabel("\n".join([x_label, *stars.lines(width)]), fontsize="small")
    figure.supylabel(y_label, fontsize="small")


def wrapped(figure: Figure, heading: str) -> str:
    """A heading in lines that fit the figure."""
    return "\n".join(textwrap.wrap(heading, int(figure.get_figwidth() * 11)))


def handle(style: Style, label: str, marker: str) -> Line2D:
    """A legend's entry."""
    return Line2D([], [], color=style.colour, linestyle=style.line, marker=marker, markersize=4, label=label)


def style_axes(axes: Axes, steps: bool = True) -> None:
    """Grid and spines; `steps`: the x axis is environment steps."""
    if steps:
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.xaxis.set_major_locator(MaxNLocator(6))
        axes.margins(x=0.01)
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def _shade(colour: str, shade: float) -> str:
    """Lighter towards 1, darker towards -1."""
    if not shade:
        return colour
    rgb = to_rgb(colour)
    red, green, blue = (part + (1 - part) * shade if shade > 0 else part * (1 + shade) for part in rgb)
    return to_hex((red, green, blue))
