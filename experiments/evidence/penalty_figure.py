"""The figure of a penalty sweep: the score against `penalty_coef`."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.evidence import statistics
from experiments.evidence.cells import NOT_RESAMPLED
from experiments.evidence.figure_style import NAMES, STATISTICS, Stars, Style, handle, style_axes, styles, wrapped
from experiments.evidence.groups import Group, differences, setting_text
from experiments.evidence.pooling import AlgorithmRow, Collected


def penalty_sweep(collected: Collected, statistic: str) -> Figure | None:
    """The score against `penalty_coef`, one panel per task, with a dot per seed; None where nothing was swept.

    A line connects groups that differ in `penalty_coef` only, and begins with their baseline at 0.
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
    # One style per algorithm, whatever its coefficients.
    rows = [AlgorithmRow(algo, algo, {}) for algo in dict.fromkeys(row.algo for row in collected.rows)]
    style, stars = styles(rows), Stars()
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
            baseline = collected.baseline(alike[0]).group
            plain = baseline and baseline.settings["penalty"] == "none" and alike[0].settings["penalty_coef"] > 0
            lines.append([baseline, *alike] if baseline and plain else alike)
        coefs = sorted({group.settings["penalty_coef"] for line in lines for group in line})
        for index, line in enumerate(lines):
            shift = (index - (len(lines) - 1) / 2) * 0.12
            _draw_sweep(axes, line, coefs, shift, statistic, style, drawn)
            for group in line:
                coef = setting_text(group.settings["penalty_coef"])
                stars.add(group.algo, f"{group.algo} at {coef} on {task}", group.notes)
        # Evenly spaced, because coefficients are often chosen as powers.
        axes.set_xticks(range(len(coefs)), [setting_text(coef) for coef in coefs])
        style_axes(axes, steps=False)
    algos = {group.algo for group in drawn}
    handles = [handle(style[row.label], stars.starred(row.label), "o") for row in rows if row.algo in algos]
    figure.legend(handles=handles, frameon=False, fontsize="small", loc="outside right center", handlelength=3)
    heading = f"Score against penalty_coef: {NAMES[statistic]} and its 95 % bootstrap interval, dots: seeds"
    heading += f"; {NOT_RESAMPLED}"
    figure.suptitle(wrapped(figure, heading), fontsize="medium")
    width = int(figure.get_figwidth() * 13)
    figure.supxlabel("\n".join(["penalty_coef", *stars.lines(width)]), fontsize="small")
    figure.supylabel("return at the score's evaluation", fontsize="small")
    return figure


def _draw_sweep(
    axes: Axes,
    line: Sequence[Group],
    coefs: Sequence[float],
    shift: float,
    statistic: str,
    style: Mapping[str, Style],
    drawn: list[Group],
) -> None:
    """A line through groups. A baseline that is in `drawn` already, as part of another line, is not drawn again."""
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
