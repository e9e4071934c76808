"""What a compiled loop runs on the device: its operations by kind, counted and timed by JAX's profiler.

Times are those under the profiler: each operation is noted, and on a GPU XLA starts the kernels one by one then, where
it otherwise starts many at once as a CUDA graph. How often each runs, and their shares, are what to read.
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

MAX_EVENTS = 1_000_000  # JAX writes no more of them, and says nothing of the others


class Kind(NamedTuple):
    """Operations of one name but for its number, as XLA calls them (`dot`, `add_convert_fusion`)."""

    name: str
    number: float  # a step, of all devices together
    seconds: float  # likewise, under the profiler


def profile(run: Callable[[int], Any], steps: int) -> list[Kind]:
    """The operations of a step of `run(steps)`, which has compiled; those that take longest first.

    On a GPU an operation is a kernel, but for those that stand for several (a library's matrix product).

    Raises:
      RuntimeError: so many events that some are missing.
    """
    options = jax.profiler.ProfileOptions()
    options.python_tracer_level = 0  # no Python functions
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder, profiler_options=options):
            jax.block_until_ready(run(steps))
        events = [event for path in Path(folder).rglob("*.trace.json.gz") for event in _events(path)]
    count: Counter[str] = Counter()
    seconds: Counter[str] = Counter()
    for event in innermost(events):
        name = re.sub(r"[.\d]+$", "", event["args"]["hlo_op"])
        count[name] += 1
        seconds[name] += event["dur"] / 1e6  # microseconds
    kinds = [Kind(name, number / steps, seconds[name] / steps) for name, number in count.items()]
    return sorted(kinds, key=lambda kind: -kind.seconds)


def _events(path: Path) -> list[dict[str, Any]]:
    with gzip.open(path) as file:
        events = json.load(file)["traceEvents"]
    if len(events) >= MAX_EVENTS:
        raise RuntimeError(f"the profile has {len(events):,} events, and JAX leaves out what is more")
    return events


def innermost(events: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The operations among the events but those that enclose others on their thread, which are told one by one.

    Not by their names: a loop over little data that a CPU runs as one kernel is a `call`, and so may be what encloses.
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


def told(kinds: Sequence[Kind], seconds: float, most: int = 6) -> str:
    """One line: how many operations a step has, and the shares in its time of those that take longest.

    Args:
      seconds: of a step without the profiler.
    """
    if not kinds:
        return "the profile shows no operation"
    total = sum(kind.seconds for kind in kinds)
    shares = [f"{kind.name} {kind.seconds / total:.0%} ({kind.number:,.0f})" for kind in kinds[:most]]
    return (
        f"{sum(kind.number for kind in kinds):,.0f} operations a step, {1e3 * total:.2f} ms under the profiler "
        f"({1e3 * seconds:.2f} ms a step without): {', '.join(shares)}"
    )
