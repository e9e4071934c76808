"""Figures of runs. Without pyplot: no global state, no display."""

import io
import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from experiments import statistics
from experiments.collected import Collected, Group, Row, base_algorithm, differences, setting_text

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
BAND_RESAMPLES = 1000
STATISTICS = {"iqm": statistics.iqm, "mean": statistics.mean}
NAMES = {"iqm": "interquartile mean", "mean": "mean"}
LABELS = {
    "return_mean": "return of an evaluation episode",
    "q_std": "std over critics, Q(s, a)",
    "value_bias": "Q minus discounted return",
}


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


def draw_curves(table: Mapping[str, np.ndarray], path: Path, title: str) -> None:
    """Writes the return and the critics' disagreement of one run over the environment steps as a PNG.

    A colour per group: the mean over its members, a band of one population std, and a thin line per member.

    Args:
      table: the columns of evaluations.csv (`records.read_evaluations`).
    """
    from experiments.records import groups, of_member, swept_columns  # brings JAX

    figure = Figure(figsize=(11, 4.2), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, sharex=True)
    names = swept_columns(table)
    found = groups(table)
    for axes, column in ((left, "return_mean"), (right, "q_std")):
        for index, (values, members) in enumerate(found.items()):
            colour, line = COLOURS[index % len(COLOURS)], LINES[index // len(COLOURS) % len(LINES)]
            label = ", ".join(f"{name} {value:g}" for name, value in zip(names, values, strict=True))
            seeds = f"{len(members)} seeds" if len(members) > 1 else "1 seed"
            curves = [of_member(table, member, column) for member in members]
            count = min(map(len, curves))
            env_steps = of_member(table, members[0], "env_steps")[:count]
            short = np.stack([curve[:count] for curve in curves])
            _draw_members(axes, env_steps, short, colour, line, f"{label} ({seeds})")
        if not np.isfinite(table[column]).any():
            axes.text(0.5, 0.5, "nothing measured", transform=axes.transAxes, ha="center", color="0.4")
            axes.set_yticks([])
        axes.set_xlabel("environment steps per member")
        _dress(axes)
    left.set_ylabel(LABELS["return_mean"])
    right.set_ylabel(LABELS["q_std"])
    left.legend(frameon=False, fontsize="small", loc="best")
    figure.suptitle(f"{title}: mean and std over seeds, thin lines the seeds", fontsize="medium")
    figure.savefig(path)


def every(collected: Collected, statistic: str) -> dict[str, Callable[[], Figure | None]]:
    """All figures by name, each as what draws it; that gives None where there is nothing to show."""
    biases = [column for group in collected.groups for column in group.columns("value_bias")]
    columns = dict.fromkeys(["return_mean", "q_std", *biases])
    draw: dict[str, Callable[[], Figure | None]] = {
        {"return_mean": "learning_curves"}.get(column, column): partial(over_time, collected, column, statistic)
        for column in columns
    }
    draw |= {"penalty_sweep": partial(penalty_sweep, collected, statistic)}
    draw |= {"performance_profile": partial(performance_profile, collected)}
    return {name: partial(_without_formulas, function) for name, function in draw.items()}


def over_time(collected: Collected, column: str, statistic: str) -> Figure | None:
    """A column of evaluations.csv over the env steps, a panel per task; None where no run has measured it.

    The statistic over seeds at each evaluation that all of them have, and its 95 % bootstrap interval as a band.
    """
    rows = [row for row in collected.rows if any(np.isfinite(g.values(column)).any() for g in row.groups.values())]
    if not rows:
        return None
    style = styles(collected.rows)
    stars = _Stars()
    figure, panels = _panels(rows, collected.tasks)
    for panel in panels:
        for row in (row for row in panel.rows if panel.task in row.groups):
            group = row.groups[panel.task]
            _draw_group(panel.axes, group, column, statistic, style[row.label], 0.15 if len(panel.rows) < 5 else 0.06)
            stars.add(row.label, f"{row.label} on {panel.task}", group.notes)
        if column.startswith("value_bias"):
            panel.axes.axhline(0, color="0.4", linewidth=0.8, zorder=1)
        _dress(panel.axes)
    name = LABELS.get(column, column.replace("_", " "))
    heading = f"{name[0].upper()}{name[1:]}: {NAMES[statistic]} over seeds, band: its 95 % bootstrap interval"
    _finish(figure, panels, style, stars, heading, "environment steps per member", name)
    return figure


def penalty_sweep(collected: Collected, statistic: str) -> Figure | None:
    """The score against `penalty_coef`, seeds as dots, a panel per task; None where nothing was swept.

    Drawn are groups that are alike in everything but `penalty_coef`, and the plain algorithm's at 0.
    """
    sweeps: dict[str, list[list[Group]]] = {}
    for task in collected.tasks:
        remaining = [group for group in collected.groups if group.env == task and group.settings["penalty"] != "none"]
        while remaining:
            alike = [g for g in remaining if not differences(remaining[0], g, {"penalty_coef"})]
            remaining = [group for group in remaining if group not in alike]
            if len(alike) > 1:
                sweeps.setdefault(task, []).append(sorted(alike, key=lambda group: group.settings["penalty_coef"]))
    if not sweeps:
        return None
    # One row per algorithm, whatever its coefficients.
    rows = [Row(algo, algo, {}) for algo in dict.fromkeys(row.algo for row in collected.rows)]
    style, stars = styles(rows), _Stars()
    columns = min(len(sweeps), 4)
    count = -(-len(sweeps) // columns)
    figure = Figure(figsize=(1.6 + 3.9 * columns, 0.9 + 3.2 * count), dpi=150, layout="constrained")
    grid = figure.subplots(count, columns, squeeze=False)
    for axes in grid.flat[len(sweeps) :]:
        axes.set_visible(False)
    drawn: list[Group] = []
    for (task, found), axes in zip(sweeps.items(), grid.flat, strict=False):
        axes.set_title(task, fontsize="medium")
        lines = []
        for alike in found:
            base = collected.base(alike[0]).group
            plain = base and base.settings["penalty"] == "none" and alike[0].settings["penalty_coef"] > 0
            lines.append([base, *alike] if base and plain else alike)
        coefs = sorted({group.settings["penalty_coef"] for line in lines for group in line})
        for index, line in enumerate(lines):
            shift = (index - (len(lines) - 1) / 2) * 0.12
            _draw_sweep(axes, line, coefs, shift, statistic, style, drawn)
            for group in line:
                coef = setting_text(group.settings["penalty_coef"])
                stars.add(group.algo, f"{group.algo} at {coef} on {task}", group.notes)
        # As far apart as they are many: coefficients are often chosen as powers.
        axes.set_xticks(range(len(coefs)), [setting_text(coef) for coef in coefs])
        _dress(axes, steps=False)
    algos = {group.algo for group in drawn}
    handles = [_handle(style[row.label], stars.starred(row.label), "o") for row in rows if row.algo in algos]
    figure.legend(handles=handles, frameon=False, fontsize="small", loc="outside right center", handlelength=3)
    heading = f"Score against penalty_coef: {NAMES[statistic]} and its 95 % bootstrap interval, dots: seeds"
    figure.suptitle(_wrapped(figure, heading), fontsize="medium")
    width = int(figure.get_figwidth() * 13)
    figure.supxlabel("\n".join(["penalty_coef", *stars.lines(width)]), fontsize="small")
    figure.supylabel("return at the score's evaluation", fontsize="small")
    return figure


def performance_profile(collected: Collected) -> Figure | None:
    """The share of seeds above each fraction of the best score, tasks weighing the same; None without scores.

    A task's scores are divided by the highest mean score among the rows. Rows without some task are left out and named.
    """
    best: dict[str, float] = {}
    for task in collected.tasks:
        scores = [row.groups[task].score for row in collected.rows if task in row.groups]
        highest = max((score.mean for score in scores if score), default=0.0)
        if highest > 0:
            best[task] = highest
    rows, stars = [], _Stars()
    for row in collected.rows:
        missing = [task for task in best if task not in row.groups or row.groups[task].scores is None]
        if missing:
            stars.texts.append(f"left out: {row.label}, which has no score on {', '.join(missing)}")
        else:
            rows.append(row)
    stars.texts += [f"left out: {task}, where no score is positive" for task in collected.tasks if task not in best]
    if not rows or not best:
        return None
    style = styles(collected.rows)
    normalised: dict[str, list[np.ndarray]] = {}
    for row in rows:
        scores_of = ((row.groups[task].scores, value) for task, value in best.items())
        normalised[row.label] = [scores / value for scores, value in scores_of if scores is not None]
    low = min(0.0, min(float(np.min(values)) for own in normalised.values() for values in own))
    high = max(float(np.max(values)) for own in normalised.values() for values in own)
    thresholds = np.linspace(low, high * 1.02, 200)
    figure, panels = _panels(rows, [""])
    for panel in panels:
        axes = panel.axes
        for row in panel.rows:
            above = [statistics.exceeds(values, thresholds) for values in normalised[row.label]]
            look = style[row.label]
            kind = {"color": look.colour, "linestyle": look.line, "marker": look.marker}
            axes.plot(thresholds, statistics.mean(*above), linewidth=1.8, markevery=25, markersize=4, **kind)
            if any(len(values) > 1 for values in normalised[row.label]):
                band = statistics.bootstrap(statistics.mean, *above, resamples=BAND_RESAMPLES)
                axes.fill_between(
                    thresholds, *band, color=look.colour, alpha=0.13 if len(panel.rows) < 5 else 0.05, linewidth=0
                )
            for task in best:
                stars.add(row.label, f"{row.label} on {task}", row.groups[task].notes)
        _dress(axes, steps=False)
        axes.set_ylim(-0.02, 1.02)
    heading = f"Performance profile over {', '.join(best)}; band: 95 % stratified bootstrap"
    below = "τ: score as a fraction of the best algorithm's mean on the task"
    _finish(figure, panels, style, stars, heading, below, "share of seeds above τ")
    return figure


def image(figure: Figure, kind: str) -> bytes:
    """The figure as `png`, `svg` or `pdf`; a figure drawn anew gives the same PNG and SVG."""
    stream = io.BytesIO()
    metadata: dict[str, Any] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind, {})
    with matplotlib.rc_context({"svg.hashsalt": "sqt_jax"}):  # else its ids are random
        figure.savefig(stream, format=kind, metadata=metadata)
    return stream.getvalue()


def _without_formulas(draw: Callable[[], Figure | None]) -> Figure | None:
    """A dollar in a version's name is a dollar: what a run's files say is not typeset."""
    with matplotlib.rc_context({"text.parse_math": False}):
        return draw()


class _Stars:
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


def _panels(rows: Sequence[Row], tasks: Sequence[str]) -> tuple[Figure, list[Panel]]:
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


def _finish(
    figure: Figure,
    panels: Sequence[Panel],
    style: Mapping[str, Style],
    stars: _Stars,
    heading: str,
    below: str,
    beside: str,
) -> None:
    """Legends, one per family, and what is written around the panels."""
    last = {panel.family: panel for panel in panels}
    for panel in last.values():
        handles = [_handle(style[row.label], stars.starred(row.label), style[row.label].marker) for row in panel.rows]
        kind: dict[str, Any] = {"handles": handles, "frameon": False, "fontsize": "small", "handlelength": 3}
        if len(last) == 1:
            figure.legend(loc="outside right center", **kind)
        elif len(last) == len(panels):  # the families stand side by side
            panel.axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), **kind)
        else:
            panel.axes.legend(loc="center left", bbox_to_anchor=(1.02, 0.5), **kind)
    figure.suptitle(_wrapped(figure, heading), fontsize="medium")
    width = int(figure.get_figwidth() * 13)
    figure.supxlabel("\n".join([below, *stars.lines(width)]), fontsize="small")
    figure.supylabel(beside, fontsize="small")


def _wrapped(figure: Figure, heading: str) -> str:
    return "\n".join(textwrap.wrap(heading, int(figure.get_figwidth() * 11)))


def _handle(style: Style, label: str, marker: str) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], color=style.colour, linestyle=style.line, marker=marker, markersize=4, label=label)


def _draw_group(axes: Axes, group: Group, column: str, statistic: str, style: Style, opacity: float) -> None:
    values = group.values(column)  # [seeds, evaluations]
    measured = np.isfinite(values).all(axis=0)
    if not measured.any():
        return
    env_steps, values = group.env_steps[measured], values[:, measured].T
    function = STATISTICS[statistic]
    middle = function(values)
    few = len(env_steps) < 30
    marker = style.marker or ("o" if few else "")
    every = 1 if few else max(1, len(env_steps) // 8)
    kind = {"color": style.colour, "linestyle": style.line, "marker": marker, "markevery": every}
    axes.plot(env_steps, middle, linewidth=1.8, markersize=4, zorder=3, **kind)
    if len(group.seeds) > 1:
        band = statistics.bootstrap(function, values, resamples=BAND_RESAMPLES)
        axes.fill_between(env_steps, *band, color=style.colour, alpha=opacity, linewidth=0, zorder=2)


def _draw_sweep(
    axes: Axes,
    line: Sequence[Group],
    coefs: Sequence[float],
    shift: float,
    statistic: str,
    style: Mapping[str, Style],
    drawn: list[Group],
) -> None:
    """A line through the groups; a base that another line has `drawn` already is not drawn again."""
    function = STATISTICS[statistic]
    places, middles = [], []
    for group in line:
        if group.scores is None:
            continue
        place = coefs.index(group.settings["penalty_coef"]) + (shift if group.settings["penalty"] != "none" else 0.0)
        middle = float(function(group.scores))
        places.append(place)
        middles.append(middle)
        if any(group is other for other in drawn):
            continue
        drawn.append(group)
        colour = style[group.algo].colour
        dots = np.full(len(group.scores), place + 0.05)
        axes.scatter(dots, group.scores, s=16, color=colour, alpha=0.45, linewidth=0, zorder=2)
        if len(group.scores) > 1:
            axes.plot([place, place], statistics.bootstrap(function, group.scores), color=colour, zorder=3)
        axes.plot([place], [middle], "o", color=colour, markersize=6, zorder=4)
    look = style[line[-1].algo]
    axes.plot(places, middles, color=look.colour, linestyle=look.line, linewidth=1.4, zorder=3)


def _draw_members(axes: Axes, env_steps: np.ndarray, values: np.ndarray, colour: str, line: str, label: str) -> None:
    """`values` [members, evaluations]: their mean, a band of one population std, and thin lines."""
    mean, std = values.mean(axis=0), values.std(axis=0)
    # Where there is one point, or NaN around it, a line alone would show nothing.
    marker = "o" if np.isfinite(mean).sum() < 30 else ""
    if len(values) > 1:
        for curve in values:
            axes.plot(env_steps, curve, color=colour, linestyle=line, linewidth=0.6, alpha=0.45, zorder=2)
        axes.fill_between(env_steps, mean - std, mean + std, color=colour, alpha=0.15, linewidth=0, zorder=1)
    axes.plot(env_steps, mean, line, color=colour, linewidth=1.8, marker=marker, markersize=3.5, label=label, zorder=3)


def _dress(axes: Axes, steps: bool = True) -> None:
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
