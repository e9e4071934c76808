"""How all figures look: colours, line styles and markers, panels, legends and footnotes."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from experiments.evidence.pooling import Row, base_algorithm

# Okabe and Ito's colours, which the colour-blind tell apart; black and yellow left out.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LINES = ("-", "--", ":")
# An algorithm has its colour in every figure: a hue of theirs per family, the base dark, the tuple form light. Line
# styles say the same without colours.
ALGORITHM_COLOURS = {
    "td3": "#00395C",
    "td3_sqt": "#0072B2",
    "td3_sqt_tuple": "#5FB3E6",
    "sac": "#7A3000",
    "sac_sqt": "#D55E00",
    "sac_sqt_tuple": "#F7A061",
    "td7": "#004D39",
    "td7_sqt": "#009E73",
    "td7_sqt_tuple": "#63D1AF",
    "maxmin": "#713A58",
    "maxmin_sqt": "#CC79A7",
    "redq": "#7A5400",
    "redq_sqt": "#E69F00",
}
OTHERS = "#555555"
FORM_LINES = {"": "-", "_sqt": (0, (5, 1.5)), "_sqt_tuple": (0, (1, 1.2))}
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
# With more lines than this, a figure has a row of panels per family instead of all in one.
MAX_LINES = 6


class Style(NamedTuple):
    colour: str
    line: Any  # one of matplotlib's line styles
    marker: str


class Panel(NamedTuple):
    family: int  # panels of one family have one legend
    rows: tuple[Row, ...]
    task: str
    axes: Axes


def styles(rows: Sequence[Row]) -> dict[str, Style]:
    """The style of each row by its label: its algorithm's; rows of one algorithm are shades of its colour."""
    found = {}
    for algo in dict.fromkeys(row.algo for row in rows):
        own = [row.label for row in rows if row.algo == algo]
        colour, line = ALGORITHM_COLOURS.get(algo, OTHERS), FORM_LINES.get(algo.removeprefix(base_algorithm(algo)), "-")
        shades = np.linspace(0.4, -0.65, len(own)) if len(own) > 1 else [0.0]
        for index, (label, shade) in enumerate(zip(own, shades, strict=True)):
            marker = MARKERS[index % len(MARKERS)] if len(own) > 1 else ""
            found[label] = Style(_shade(colour, float(shade)), line, marker)
    return found


class Stars:
    """Footnotes of a figure: what is not all it should be has a star in the legend."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.labels: set[str] = set()

    def add(self, label: str, where: str, notes: Sequence[str]) -> None:
        for note in notes:
            self.labels.add(label)
            if f"* {where}: {note}" not in self.texts:
                self.texts.append(f"* {where}: {note}")

    def starred(self, label: str) -> str:
        return f"{label} *" if label in self.labels else label

    def lines(self, width: int, most: int = 8) -> list[str]:
        shown = [line for text in self.texts[:most] for line in textwrap.wrap(text, width)]
        return shown + ([f"... and {len(self.texts) - most} more"] if len(self.texts) > most else [])


def make_panels(rows: Sequence[Row], tasks: Sequence[str]) -> tuple[Figure, list[Panel]]:
    """A figure with a panel per task; with many rows, each family of algorithms has a row of panels of its own."""
    families = [tuple(rows)]
    if len(rows) > MAX_LINES:
        names = dict.fromkeys(base_algorithm(row.algo) for row in rows)
        families = [tuple(row for row in rows if base_algorithm(row.algo) == name) for name in names]
    alone = len(families) == 1  # then the tasks may be more than fit in a row
    columns = min(len(tasks), 4) if alone else len(tasks) if len(tasks) > 1 else len(families)
    places = [(family, task) for family in range(len(families)) for task in tasks]
    count = -(-len(places) // columns)
    size = (2.6 + 3.6 * columns, 0.9 + 2.8 * count) if count > 1 or alone else (1 + 3.9 * columns, 5.2)
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    grid = figure.subplots(count, columns, squeeze=False)
    panels = []
    for index, axes in enumerate(grid.flat):
        if index >= len(places):
            axes.set_visible(False)
            continue
        family, task = places[index]
        panels.append(Panel(family, families[family], task, axes))
        if family:  # the panels of a task have one scale
            axes.sharex(panels[tasks.index(task)].axes)
            axes.sharey(panels[tasks.index(task)].axes)
        if not family or len(tasks) == 1:
            axes.set_title(task, fontsize="medium")
    return figure, panels


def finish(
    figure: Figure,
    panels: Sequence[Panel],
    style: Mapping[str, Style],
    stars: Stars,
    heading: str,
    below: str,
    beside: str,
) -> None:
    """Legends, one per family, and what is written around the panels."""
    last = {panel.family: panel for panel in panels}
    for panel in last.values():
        handles = [handle(style[row.label], stars.starred(row.label), style[row.label].marker) for row in panel.rows]
        kind: dict[str, Any] = {"handles": handles, "frameon": False, "fontsize": "small", "handlelength": 3}
        if len(last) == 1:
            figure.legend(loc="outside right center", **kind)
        elif len(last) == len(panels):  # the families stand side by side
            panel.axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), **kind)
        else:
            panel.axes.legend(loc="center left", bbox_to_anchor=(1.02, 0.5), **kind)
    figure.suptitle(wrapped(figure, heading), fontsize="medium")
    width = int(figure.get_figwidth() * 13)
    figure.supxlabel("\n".join([below, *stars.lines(width)]), fontsize="small")
    figure.supylabel(beside, fontsize="small")


def wrapped(figure: Figure, heading: str) -> str:
    return "\n".join(textwrap.wrap(heading, int(figure.get_figwidth() * 11)))


def handle(style: Style, label: str, marker: str) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], color=style.colour, linestyle=style.line, marker=marker, markersize=4, label=label)


def dress(axes: Axes, steps: bool = True) -> None:
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
