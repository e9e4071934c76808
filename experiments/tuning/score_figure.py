"""The figure of a tuning: the value of each trial against each setting, with the winner and its fresh seeds."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from experiments.evidence import statistics
from experiments.evidence.figure_style import algorithm_style, in_our_style, style_axes, wrapped
from experiments.tuning.report import NAMES, Setup, Tuned, values_of
from experiments.tuning.space import Axis


@in_our_style
def draw(tuned: Sequence[Tuned], setup: Setup) -> bytes | None:
    """The figure as a PNG: a row per tuned algorithm, a panel per setting; None where nothing was tuned."""
    rows = [one for one in tuned if one.winner.study and one.winner.trial]
    if not rows:
        return None
    columns = max(len(one.winner.study.axes) for one in rows if one.winner.study)
    figure = Figure(figsize=(2.2 + 3.9 * columns, 1.2 + 3.1 * len(rows)), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(rows), columns, squeeze=False, sharey=True)
    for axes in panels.flat:
        axes.set_visible(False)
    for row, one in zip(panels, rows, strict=True):
        assert one.winner.study
        for panel, axis in zip(row, one.winner.study.axes, strict=False):
            panel.set_visible(True)
            _draw_panel(panel, one, axis, setup)
        row[0].set_ylabel(NAMES[setup.objective])
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, fontsize="small", loc="outside lower center", ncols=4)
    heading = (
        f"{NAMES[setup.objective].capitalize()} of each trial, mean over {len(setup.tuned_on)} seeds; the winner on "
    )
    figure.suptitle(
        wrapped(figure, f"{heading}{len(setup.fresh)} fresh seeds with its 95 % bootstrap interval"), fontsize="medium"
    )
    stream = io.BytesIO()
    figure.savefig(stream)
    return stream.getvalue()


def _draw_panel(axes: Axes, one: Tuned, axis: Axis, setup: Setup) -> None:
    study, winner = one.winner.study, one.winner.trial
    assert study and winner
    colour, _ = algorithm_style(one.winner.task.algo)
    done = [trial for trial in study.trials if trial.value is not None]
    look: dict[str, Any] = {"color": colour, "alpha": 0.45, "markersize": 4.5, "markeredgewidth": 0, "label": "trial"}
    axes.plot([t.params[axis.name] for t in done], np.array([t.value for t in done], float), "o", **look)
    lost = [trial.params[axis.name] for trial in study.trials if trial.state.name == "PRUNED"]
    if lost:  # at the bottom, whatever the scale
        axes.plot(
            lost, np.full(len(lost), 0.02), "x", color="0.4", transform=axes.get_xaxis_transform(), label="diverged"
        )
    place = winner.params[axis.name]
    axes.plot(
        [place],
        np.array([winner.value], float),
        "*",
        color="#D55E00",
        markersize=13,
        markeredgecolor="white",
        label="winner",
    )
    fresh = values_of(one.group, setup.objective)
    if fresh is not None:
        if len(fresh) > 1:
            axes.plot([place, place], statistics.bootstrap(statistics.mean, fresh), color="black", linewidth=1.4)
        axes.plot([place], [fresh.mean()], "s", color="black", markersize=5, label="winner on fresh seeds")
    if axis.log:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    margin = 1.08 if axis.log else 0.03 * (axis.high - axis.low)
    axes.set_xlim((axis.low / margin, axis.high * margin) if axis.log else (axis.low - margin, axis.high + margin))
    axes.set_xlabel(f"{axis.name} of {one.winner.task.algo}", fontsize="small")
    style_axes(axes, steps=False)
