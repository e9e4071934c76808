"""The device operations of a compiled loop by kind, counted and timed by JAX's profiler.

The profiler slows the loop: it records each operation, and on a GPU XLA then launches kernels one by one instead of
many at once as a CUDA graph. Read the counts and the shares of the time, not the times.
"""

import gzip
import json
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

MAX_EVENTS = 1_000_000  # JAX drops further events without a message


class Kind(NamedTuple):
    """Operations of one XLA name without its number (`dot`, `add_convert_fusion`)."""

    name: str
    number: float  # per step, all devices together
    seconds: float  # per step, all devices together, under the profiler


def profile(run: Callable[[int], Any], steps: int) -> list[Kind]:
    """The operations of one step of `run(steps)`, longest first. `run` has to be compiled already.

    On a GPU an operation is a kernel, except a few that stand for several (a library's matrix product).

    Raises:
      RuntimeError: the profile is incomplete, because it has too many events.
    """
    events = record(run, steps)
    count: Counter[str] = Counter()
    seconds: Counter[str] = Counter()
    for event in innermost(events):
        name = re.sub(r"[.\d]+$", "", event["args"]["hlo_op"])
        count[name] += 1
        seconds[name] += event["dur"] / 1e6  # microseconds
    kinds = [Kind(name, number / steps, seconds[name] / steps) for name, number in count.items()]
    return sorted(kinds, key=lambda kind: -kind.seconds)


def record(run: Callable[[int], Any], steps: int) -> list[dict[str, Any]]:
    """The profiler's events of `run(steps)`; raises as `profile`."""
    options = jax.profiler.ProfileOptions()
    options.python_tracer_level = 0  # no Python functions
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder, profiler_options=options):
            jax.block_until_ready(run(steps))
        return [event for path in Path(folder).rglob("*.trace.json.gz") for event in _events(path)]


def _events(path: Path) -> list[dict[str, Any]]:
    with gzip.open(path) as file:
        events = json.load(file)["traceEvents"]
    if len(events) >= MAX_EVENTS:
        raise RuntimeError(f"the profile has {len(events):,} events, and JAX drops further ones")
    return events


def innermost(events: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The operations among profiler events, without those that enclose others on their thread.

    Names do not identify them: `call` is a loop that a CPU runs as one kernel, or an operation that encloses others.
    """
    operations = [event for event in events if event.get("ph") == "X" and event.get("args", {}).get("hlo_op")]
    operations.sort(key=lambda event: (event["pid"], event["tid"], event["ts"], -event["dur"]))

    def encloses(one: dict[str, Any], following: dict[str, Any]) -> bool:
        if (one["pid"], one["tid"]) != (following["pid"], following["tid"]):
            return False
        end = one["ts"] + one["dur"]
        return following["ts"] < end and following["ts"] + following["dur"] <= end

    pairs = zip(operations, operations[1:], strict=False)
    return [one for one, following in pairs if not encloses(one, following)] + operations[-1:]


def summary_line(kinds: Sequence[Kind], seconds: float, most: int = 6) -> str:
    """One line: the number of operations per step, and the share of time of the longest kinds.

    Args:
      kinds: as from `profile`.
      seconds: of a step without the profiler.
      most: number of kinds in the line.
    """
    if not kinds:
        return "the profile has no operations"
    total = sum(kind.seconds for kind in kinds)
    shares = [f"{kind.name} {kind.seconds / total:.0%} ({kind.number:,.0f})" for kind in kinds[:most]]
    return (
        f"{sum(kind.number for kind in kinds):,.0f} operations per step, {1e3 * total:.2f} ms under the profiler "
        f"({1e3 * seconds:.2f} ms per step without): {', '.join(shares)}"
    )
