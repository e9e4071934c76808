"""The figure of the tabular study: errors, bias and std over the steps."""

from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from experiments.evidence.figure_style import COLOURS, in_our_style
from experiments.theorem import mdps
from experiments.theorem.learning_curves import LearningCurves, Names, collapsed, interval

STYLES = {  # colour, line, label
    "q_learning": (COLOURS[0], "-", "Q-learning"),
    "double_q": (COLOURS[2], "-", "Double Q"),
    "weighted_double_q": (COLOURS[3], "-", "Weighted Double Q"),
    "maxmin": (COLOURS[5], "-", "MaxMin"),
    "sqt": (COLOURS[1], "--", "SQT"),
    "sqt_shared": (COLOURS[4], ":", "SQT, same data"),
}
QUANTITIES = {"error_max": "max |Q − Q*|", "bias": "bias, mean (Q − Q*)", "std": "std over tables"}


def _shade(colour: str, share: float) -> tuple[float, float, float]:
    """`share` from 0 to 1: from half white over the colour itself to a darker one."""
    red, green, blue = to_rgb(colour)
    if share < 0.5:
        return tuple(1 - (1 - c) * (0.45 + 1.1 * share) for c in (red, green, blue))  # type: ignore[return-value]
    return tuple(c * (1 - 0.8 * (share - 0.5)) for c in (red, green, blue))  # type: ignore[return-value]


@in_our_style
def draw(results: Mapping[Names, LearningCurves], file: Path | BinaryIO) -> None:
    """Writes a PNG with a panel per MDP and quantity: means over seeds and their 95 % intervals over the steps."""
    names = list(dict.fromkeys(mdp for mdp, _ in results))
    figure = Figure(figsize=(4.2 * len(names) + 0.6, 9.2), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(QUANTITIES), len(names), squeeze=False, sharex="col")
    for column, mdp in enumerate(names):
        for row, (quantity, label) in enumerate(QUANTITIES.items()):
            axes = panels[row, column]
            for (where, algo), curves in results.items():
                if where == mdp:
                    _draw(axes, algo, curves, quantity)
            _style_axes(axes, quantity)
            if column == 0:
                axes.set_ylabel(label)
        panels[0, column].set_title(mdps.TITLES[mdp], fontsize="medium")
        panels[-1, column].set_xlabel("steps")
    handles = {text: line for axes in panels.flat for line, text in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=5, frameon=False, fontsize="small"
    )
    seeds = len(next(iter(results.values())).tables)
    figure.suptitle(
        f"means over {seeds} seeds, bands: 95 % intervals; Q: all tables of an algorithm", fontsize="medium"
    )
    figure.savefig(file)


def _label(algo: str, curves: LearningCurves, index: int) -> str:
    coef, label = curves.coefs[index], STYLES[algo][2]
    return label if coef is None or algo == "sqt_shared" and collapsed(curves) else f"{label}, coef {coef:g}"


def _draw(axes: Axes, algo: str, curves: LearningCurves, quantity: str) -> None:
    colour, line, _ = STYLES[algo]
    values = getattr(curves.record, quantity)
    if quantity == "std" and not values.any():
        return  # a single table, or tables that are equal
    # Only SQT depends on its coefficients; other algorithms' curves would cover each other.
    shown = range(len(curves.coefs)) if algo == "sqt" else [len(curves.coefs) - 1]
    for k in shown:
        name = _label(algo, curves, k)
        tint = _shade(colour, k / (len(curves.coefs) - 1)) if len(shown) > 1 else colour
        mean, width = np.array([interval(values[:, k, c]) for c in range(len(curves.steps))]).T
        axes.fill_between(curves.steps, mean - width, mean + width, color=tint, alpha=0.15, linewidth=0)
        axes.plot(curves.steps, mean, line, color=tint, linewidth=1.6, label=name)


def _style_axes(axes: Axes, quantity: str) -> None:
    axes.set_xscale("log")
    if quantity == "bias":
        axes.axhline(0, color="0.3", linewidth=0.8)
    elif axes.lines:
        axes.set_yscale("log")
        # A band may reach 0 or less, which a logarithmic axis cannot show: the lines limit the axis.
        heights = np.concatenate([np.asarray(line.get_ydata(), float) for line in axes.lines])
        heights = heights[np.isfinite(heights) & (heights > 0)]
        if heights.size:
            axes.set_ylim(bottom=heights.min() / 1.5)
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.text(0.5, 0.5, "all tables agree", transform=axes.transAxes, ha="center", color="0.4")
        axes.set_yticks([])
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
