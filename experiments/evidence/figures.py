"""Figures of runs, drawn without pyplot: they need no global state and no display."""

import io
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.evidence import statistics
from experiments.evidence.cells import NOT_RESAMPLED
from experiments.evidence.figure_style import (
    COLOURS,
    LINES,
    NAMES,
    STATISTICS,
    Stars,
    Style,
    add_texts,
    in_our_style,
    make_panels,
    style_axes,
    styles,
)
from experiments.evidence.groups import Group
from experiments.evidence.penalty_figure import penalty_sweep
from experiments.evidence.pooling import Collected

BAND_RESAMPLES = 1000
MAX_LABELS = 20  # of a run's curves; a batch of a tuning has many configurations
LABELS = {
    "return_mean": "return of an evaluation episode",
    "q_std": "std over critics, Q(s, a)",
    "value_bias": "Q minus discounted return",
}


@in_our_style
def draw_curves(table: Mapping[str, np.ndarray], path: Path, title: str) -> None:
    """Writes one run's figure as a PNG: the return and the critics' disagreement over the environment steps.

    A colour per group (the seeds with one value of each swept setting): the mean over seeds, a band of one std over
    seeds (ddof 0, population), and a thin line per seed.

    Args:
      table: the columns of evaluations.csv (`records.read_evaluations`), [rows] each.
    """
    from experiments.running.records import groups, of_member, swept_columns  # imports JAX

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
        style_axes(axes)
    left.set_ylabel(LABELS["return_mean"])
    right.set_ylabel(LABELS["q_std"])
    if len(found) <= MAX_LABELS:
        left.legend(frameon=False, fontsize="small", loc="best")
    heading = f"{title}: mean and std (ddof 0) over seeds, thin lines: the seeds"
    figure.suptitle(heading, fontsize="medium")
    figure.savefig(path)


def all_figures(collected: Collected, statistic: str) -> dict[str, Callable[[], Figure | None]]:
    """All figures by name, each as a function that draws it; it returns None where there is nothing to draw.

    Args:
      statistic: over seeds, `iqm` or `mean`.
    """
    biases = [column for group in collected.groups for column in group.columns("value_bias")]
    columns = dict.fromkeys(["return_mean", "q_std", *biases])
    draw: dict[str, Callable[[], Figure | None]] = {
        {"return_mean": "learning_curves"}.get(column, column): partial(over_time, collected, column, statistic)
        for column in columns
    }
    draw |= {"penalty_sweep": partial(penalty_sweep, collected, statistic)}
    draw |= {"performance_profile": partial(performance_profile, collected)}
    return {name: in_our_style(function) for name, function in draw.items()}


def over_time(collected: Collected, column: str, statistic: str) -> Figure | None:
    """A column of evaluations.csv over the env steps, one panel per task; None where no run has measured it.

    Lines are the statistic over seeds at each evaluation that all seeds have, bands its 95 % bootstrap interval.
    """
    rows = [row for row in collected.rows if any(np.isfinite(g.values(column)).any() for g in row.groups.values())]
    if not rows:
        return None
    style = styles(collected.rows)
    stars = Stars()
    figure, panels = make_panels(rows, collected.tasks)
    for panel in panels:
        for row in (row for row in panel.rows if panel.task in row.groups):
            group = row.groups[panel.task]
            _draw_group(panel.axes, group, column, statistic, style[row.label], 0.15 if len(panel.rows) < 5 else 0.06)
            stars.add(row.label, f"{row.label} on {panel.task}", group.notes)
        if column.startswith("value_bias"):
            panel.axes.axhline(0, color="0.4", linewidth=0.8, zorder=1)
        style_axes(panel.axes)
    name = LABELS.get(column, column.replace("_", " "))
    heading = f"{name[0].upper()}{name[1:]}: {NAMES[statistic]} over seeds, band: its 95 % bootstrap interval"
    add_texts(figure, panels, style, stars, heading, "environment steps per member", name)
    return figure


def performance_profile(collected: Collected) -> Figure | None:
    """The share of seeds above each fraction of the best score, with equal weights of tasks; None without scores.

    A task's scores are divided by the highest mean score among the rows. A footnote names the rows that lack a task and
    are left out.
    """
    best: dict[str, float] = {}
    for task in collected.tasks:
        scores = [row.groups[task].score for row in collected.rows if task in row.groups]
        highest = max((score.mean for score in scores if score), default=0.0)
        if highest > 0:
            best[task] = highest
    rows, stars = [], Stars()
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
    figure, panels = make_panels(rows, [""])
    for panel in panels:
        axes = panel.axes
        for row in panel.rows:
            above = [statistics.exceeds(values, thresholds) for values in normalised[row.label]]
            look = style[row.label]
            kind = {"color": look.colour, "linestyle": look.line, "marker": look.marker}
            axes.plot(thresholds, statistics.mean(*above), linewidth=1.8, markevery=25, markersize=4, **kind)
            if all(len(values) > 1 for values in normalised[row.label]):
                band = statistics.bootstrap(statistics.mean, *above, resamples=BAND_RESAMPLES)
                axes.fill_between(
                    thresholds, *band, color=look.colour, alpha=0.13 if len(panel.rows) < 5 else 0.05, linewidth=0
                )
            for task in best:
                stars.add(row.label, f"{row.label} on {task}", row.groups[task].notes)
        style_axes(axes, steps=False)
        axes.set_ylim(-0.02, 1.02)
    heading = f"Performance profile over {', '.join(best)}; band: 95 % stratified bootstrap; {NOT_RESAMPLED}"
    below = "τ: score as a fraction of the best algorithm's mean on the task"
    add_texts(figure, panels, style, stars, heading, below, "share of seeds above τ")
    return figure


@in_our_style
def image(figure: Figure, kind: str) -> bytes:
    """The figure as `png`, `svg` or `pdf`. Drawing a figure again gives the same bytes of PNG and SVG."""
    stream = io.BytesIO()
    metadata: dict[str, Any] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind, {})
    figure.savefig(stream, format=kind, metadata=metadata)
    return stream.getvalue()


def file_contents(draw: Mapping[str, Callable[[], Figure | None]], kind: str) -> tuple[dict[str, bytes], list[str]]:
    """The figures of `all_figures` as images by file name, and the names of those with nothing to draw."""
    drawn = {name: function() for name, function in draw.items()}
    contents = {f"{name}.{kind}": image(figure, kind) for name, figure in drawn.items() if figure}
    return contents, [name for name, figure in drawn.items() if figure is None]


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


def _draw_members(axes: Axes, env_steps: np.ndarray, values: np.ndarray, colour: str, line: str, label: str) -> None:
    """`values` [members, evaluations]: their mean, a band of one std (ddof 0), and thin lines."""
    mean, std = values.mean(axis=0), values.std(axis=0)
    # A single point, or one between NaNs, has no line: markers show it.
    marker = "o" if np.isfinite(mean).sum() < 30 else ""
    if len(values) > 1:
        for curve in values:
            axes.plot(env_steps, curve, color=colour, linestyle=line, linewidth=0.6, alpha=0.45, zorder=2)
        axes.fill_between(env_steps, mean - std, mean + std, color=colour, alpha=0.15, linewidth=0, zorder=1)
    axes.plot(env_steps, mean, line, color=colour, linewidth=1.8, marker=marker, markersize=3.5, label=label, zorder=3)
