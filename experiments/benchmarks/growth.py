"""Cost over members, critics and the replay's capacity: `python -m experiments.bench --suite=growth`."""

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator, StrMethodFormatter

from experiments.benchmarks.measure_replays import REPLAYS, replay_case
from experiments.benchmarks.measure_updates import updates
from experiments.benchmarks.measurements import Case, Failure, Measurement, measure_cases
from experiments.evidence.figure_style import ALGORITHM_COLOURS, COLOURS, MARKERS, in_our_style
from experiments.running import files
from sqt_jax.members import usable_devices

MEMBERS = (1, 2, 5, 10, 25, 50)
CRITICS = (2, 5, 10)
CAPACITIES = (10_000, 100_000, 1_000_000)
# Varied quantity -> the figure's axis labels.
LABELS = {
    "members": ("members", "ms per update of one member"),
    "critics": ("critics", "ms per update of one member"),
    "capacity": ("capacity of the replay", "µs per sample and feedback of one member"),
}
PER_SECOND = {"members": 1e3, "critics": 1e3, "capacity": 1e6}


def measure_growth(algos: Sequence[str], task: str, members: int, **timing: Any) -> Iterator[Measurement | Failure]:
    """Measures updates over members and over critics, and samples over capacities.

    The points of a line are interleaved, so that a change of the machine's speed does not bend it. Members are spread
    over devices as in a run.

    Args:
      members: where the number does not vary.
      timing: `seconds` and `repeats` of `timing.measure`.
    """
    for algo in algos:
        yield from measure_cases([_update(algo, task, count, ("members", algo, count)) for count in MEMBERS], **timing)
        critics = [_update(algo, task, members, ("critics", algo, count), ensemble_size=count) for count in CRITICS]
        yield from measure_cases(critics, **timing)
    for kind in REPLAYS:
        yield from measure_cases([_sample(kind, task, members, capacity) for capacity in CAPACITIES], **timing)


def _update(algo: str, task: str, members: int, point: tuple[str, str, int], **settings: int) -> Case:
    varied, _, value = point
    what = f"{algo}, {task} sizes" + (f", {value} critics" if varied == "critics" else "")
    devices = usable_devices(members)
    measurement = Measurement(
        suite="growth", what=what, members=members, unit="member updates", devices=devices, point=point
    )
    return Case(measurement, functools.partial(updates, algo, task, members, devices, **settings))


def _sample(kind: str, task: str, members: int, capacity: int) -> Case:
    measurement, prepare = replay_case(kind, "sample", task, capacity, members)
    return Case(dataclasses.replace(measurement, suite="growth", point=("capacity", kind, capacity)), prepare)


def draw(found: Sequence[Measurement], folder: Path) -> list[Path]:
    """Writes a PNG figure per varied quantity into `folder`, which is created; returns their paths.

    Raises:
      OSError: a file cannot be written.
    """
    paths = []
    for varied, (x_label, y_label) in LABELS.items():
        points: dict[str, dict[int, float]] = {}
        for measurement in found:
            if measurement.point and measurement.point[0] == varied:
                _, line, value = measurement.point
                points.setdefault(line, {})[value] = PER_SECOND[varied] / measurement.rate
        if points:
            folder.mkdir(parents=True, exist_ok=True)
            paths.append(folder / f"growth_{varied}.png")
            _draw(points, x_label, y_label, paths[-1])
    return paths


@in_our_style
def _draw(points: dict[str, dict[int, float]], x_label: str, y_label: str, path: Path) -> None:
    figure = Figure(figsize=(5, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for index, (name, line) in enumerate(points.items()):
        colour = ALGORITHM_COLOURS.get(name, COLOURS[index % len(COLOURS)])
        axes.plot(list(line), list(line.values()), color=colour, marker=MARKERS[index % len(MARKERS)], label=name)
    values = sorted({x for line in points.values() for x in line})
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(FixedLocator(values))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(bottom=0)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(alpha=0.3)
    axes.legend()
    with files.atomic_file(path) as file:
        figure.savefig(file, format="png", dpi=150)
