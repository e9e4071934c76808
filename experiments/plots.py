"""Pictures of a run, from its evaluations.csv."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from experiments.records import groups, of_member, swept_columns

# Okabe and Ito's colours, which the colour-blind tell apart; black and yellow left out.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LINES = ("-", "--", ":")


def draw_curves(table: Mapping[str, np.ndarray], path: Path, title: str) -> None:
    """Writes the return and the critics' disagreement over the environment steps as a PNG.

    A colour per group: the mean over its members, a band of one population std, and a thin line per member.

    Args:
      table: the columns of evaluations.csv (`records.read_evaluations`).
    """
    # Without pyplot: no global state, no display.
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
            _draw_group(axes, table, members, column, colour, line, f"{label} ({seeds})")
        if not np.isfinite(table[column]).any():
            axes.text(0.5, 0.5, "nothing measured", transform=axes.transAxes, ha="center", color="0.4")
            axes.set_yticks([])
        axes.set_xlabel("environment steps per member")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.xaxis.set_major_locator(MaxNLocator(6))
        axes.grid(alpha=0.25, linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.margins(x=0.01)
    left.set_ylabel("return of an evaluation episode")
    right.set_ylabel("std over critics, Q(s, a)")
    left.legend(frameon=False, fontsize="small", loc="best")
    figure.suptitle(f"{title}: mean and std over seeds, thin lines the seeds", fontsize="medium")
    figure.savefig(path)


def _draw_group(
    axes: Axes,
    table: Mapping[str, np.ndarray],
    members: list[int],
    column: str,
    colour: str,
    line: str,
    label: str,
) -> None:
    curves = [of_member(table, member, column) for member in members]
    count = min(map(len, curves))
    values = np.stack([curve[:count] for curve in curves])
    env_steps = of_member(table, members[0], "env_steps")[:count]
    mean, std = values.mean(axis=0), values.std(axis=0)
    # Where there is one point, or NaN around it, a line alone would show nothing.
    marker = "o" if np.isfinite(mean).sum() < 30 else ""
    if len(members) > 1:
        for curve in values:
            axes.plot(env_steps, curve, color=colour, linestyle=line, linewidth=0.6, alpha=0.45, zorder=2)
        axes.fill_between(env_steps, mean - std, mean + std, color=colour, alpha=0.15, linewidth=0, zorder=1)
    axes.plot(env_steps, mean, line, color=colour, linewidth=1.8, marker=marker, markersize=3.5, label=label, zorder=3)
