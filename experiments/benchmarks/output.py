"""How the benchmark shows its measurements: a line each, a JSON file, and at the end tables, ratios and figures."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import jax
from rich.table import Table

from experiments.benchmarks import compare, growth, kernels
from experiments.benchmarks.machine import machine
from experiments.benchmarks.measurements import Failure, Measurement, with_devices
from experiments.benchmarks.ratio import ratio_text
from experiments.commandline.arguments import UsageError
from experiments.running import files
from experiments.surroundings.consoles import console

HEADER = ("suite", "what", "members", "rate", "unit", "compile s", "GFLOP", "of the peak", "operations per step")
# The reference of a ratio, by suite and physics.
REFERENCES = {
    ("physics", "mujoco"): "MuJoCo without JAX",
    ("physics", "mjx"): "mjx, the file's iterations",
    ("loop", "mujoco"): "mjx",
    ("loop", "warp"): "mjx",
}


def print_result(found: Measurement | Failure) -> None:
    """Prints a measurement, and its profile if it has one; or a line that begins with `failed`."""
    if isinstance(found, Failure):
        print(f"failed: {found.what}: {found.why}", flush=True)
        return
    print(f"{found.suite}: {found.what}, {found.members} members: {' '.join(found.figure)}", flush=True)
    if found.kinds is not None:
        print(f"  {kernels.summary_line(found.kinds, found.members / found.rate)}", flush=True)


def save_json(path: Path, measurements: Sequence[Measurement], failures: Sequence[Failure], peak: float) -> None:
    """Writes the machine, the peak in operations per second (0: not measured), measurements and failures.

    Raises:
      UsageError: the file cannot be written.
    """
    content = {
        "machine": machine(),
        "peak": peak,
        "rows": [dataclasses.asdict(found) for found in measurements],
        "failed": [failure._asdict() for failure in failures],
    }
    try:
        with files.atomic_file(path) as file:
            file.write((json.dumps(content, indent=1) + "\n").encode())
    except OSError as error:
        raise UsageError(f"--json={path}: expects a file that can be written: {error.strerror}") from None


def print_all(measurements: Sequence[Measurement], peak: float, figures: Path) -> None:
    """Prints all measurements as a table and as Markdown, then their ratios; draws growth into the folder `figures`.

    Raises:
      UsageError: a figure cannot be written.
    """
    table = Table(*HEADER, title="median of repeats")
    for found in measurements:
        table.add_row(*cells(found, peak))
    console().print(table)
    print(markdown(measurements, peak))
    print("\n".join(physics_ratios(measurements) + compare.ratios(measurements)))
    try:
        for path in growth.draw(measurements, figures):
            print(path)
    except OSError as error:
        raise UsageError(f"--figures={figures}: expects a folder that can be written: {error.strerror}") from None


def cells(found: Measurement, peak: float) -> tuple[str, ...]:
    """A measurement's cells under `HEADER`; cells that were not measured are empty.

    Args:
      peak: operations per second of one device; 0 if it was not measured.
    """
    compiled = "" if found.compile_seconds is None else f"{found.compile_seconds:.1f}"
    counted = f"{found.operations / 1e9:.3g}" if found.operations else ""
    peak *= 1 if jax.default_backend() == "cpu" else found.devices  # a CPU's devices share its cores
    share = f"{found.rate * found.operations / peak:.0%}" if found.operations and peak else ""
    profiled = f"{sum(kind.number for kind in found.kinds):,.0f}" if found.kinds else ""
    return (found.suite, found.what, str(found.members), *found.figure, compiled, counted, share, profiled)


def markdown(measurements: Sequence[Measurement], peak: float) -> str:
    """The measurements as a Markdown table; `peak` as in `cells`."""
    lines = [HEADER, ("---",) * len(HEADER), *(cells(found, peak) for found in measurements)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def physics_ratios(measurements: Sequence[Measurement]) -> list[str]:
    """A line per measurement with a reference in `REFERENCES`: the ratio of their rates."""
    by_case = {(found.suite, found.what, found.members): found for found in measurements}
    lines = []
    for (suite, what, members), found in by_case.items():
        on_devices = with_devices("", found.devices)
        task, _, physics = what.removesuffix(on_devices).partition(", ")
        reference = REFERENCES.get((suite, physics), "")
        if other := by_case.get((suite, f"{task}, {reference}{on_devices}", members)):
            ratio = ratio_text(found, other)
            lines.append(f"{task}, {members} members{on_devices}: {physics} / {reference} = {ratio}")
    return lines
