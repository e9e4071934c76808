"""What a compiled loop runs on the device: its operations by kind, counted and timed by JAX's profiler."""

import gzip
import json
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

# They contain others, which are told one by one.
CONTAINERS = ("while", "conditional", "call")


class Kind(NamedTuple):
    """Operations of one name but for its number, as XLA calls them (`dot`, `add_convert_fusion`)."""

    name: str
    number: float  # a step
    seconds: float  # a step, of all devices together


def profile(run: Callable[[int], Any], steps: int) -> list[Kind]:
    """The operations of a step of `run(steps)`, which has compiled; those that take longest first.

    On a GPU an operation is a kernel, but for those that stand for several (a library's matrix product).
    """
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(run(steps))
        events = [event for path in Path(folder).rglob("*.trace.json.gz") for event in _events(path)]
    count: Counter[str] = Counter()
    seconds: Counter[str] = Counter()
    for event in events:
        operation = event.get("args", {}).get("hlo_op")
        name = re.sub(r"[.\d]+$", "", operation or "")
        if operation and event.get("ph") == "X" and name not in CONTAINERS:
            count[name] += 1
            seconds[name] += event["dur"] / 1e6  # microseconds
    kinds = [Kind(name, number / steps, seconds[name] / steps) for name, number in count.items()]
    return sorted(kinds, key=lambda kind: -kind.seconds)


def _events(path: Path) -> list[dict[str, Any]]:
    with gzip.open(path) as file:
        return json.load(file)["traceEvents"]


def told(kinds: Sequence[Kind], most: int = 6) -> str:
    """One line: how many operations a step has, and the shares in its time of those that take longest."""
    total = sum(kind.seconds for kind in kinds)
    shares = [f"{kind.name} {kind.seconds / total:.0%} ({kind.number:,.0f})" for kind in kinds[:most]]
    return f"{sum(kind.number for kind in kinds):,.0f} operations a step, {1e3 * total:.2f} ms: {', '.join(shares)}"
