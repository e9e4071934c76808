"""What a GPU did in a recorded loop: kernels, CUDA graphs and copies to the host, from the profiler's events."""

import re
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

from experiments.benchmarks import kernels

Event = dict[str, Any]


class Work(NamedTuple):
    """Counts of a recorded loop, all devices together."""

    kernels: int
    graphs: int  # launches of CUDA graphs; the kernels in a graph may not be listed
    copies_to_host: int
    seconds: float  # that the device was busy
    longest: dict[str, float]  # name without numbers -> share of these seconds, longest first


def count(events: Sequence[Event]) -> Work:
    """The work of a GPU, or of a CPU if the events name no GPU.

    Raises:
      RuntimeError: a GPU has no stream of work; the text names what it has.
    """
    processes = _names(events, "process_name")
    gpus = {pid for (pid, _), name in processes.items() if "/device:GPU" in name}
    work = _on_streams(events, gpus) if gpus else kernels.innermost(events)
    names = Counter(re.sub(r"[.\d]+$", "", event["name"]) for event in work)
    seconds: Counter[str] = Counter()
    for event in work:
        seconds[re.sub(r"[.\d]+$", "", event["name"])] += event["dur"] / 1e6  # microseconds
    total = sum(seconds.values())
    copies = sum(number for name, number in names.items() if re.match("mem(cpy|set)", name, re.I))
    run = sum(number for name, number in names.items() if name.startswith("CudaGraphExec"))
    calls = [event for event in events if event.get("ph") == "X" and event["pid"] not in gpus]
    launched = sum(bool(re.search("graph_?launch", event["name"], re.I)) for event in calls)
    return Work(
        kernels=len(work) - copies - run,
        graphs=max(launched, run),
        copies_to_host=sum(number for name, number in names.items() if re.match("memcpyd(2|to)h", name, re.I)),
        seconds=total,
        longest={name: spent / total for name, spent in seconds.most_common(5)},
    )


def _names(events: Sequence[Event], kind: str) -> dict[tuple[int, int], str]:
    """(process, thread) -> its name in the trace."""
    return {
        (event["pid"], event.get("tid", 0)): event["args"]["name"]
        for event in events
        if event.get("ph") == "M" and event.get("name") == kind
    }


def _on_streams(events: Sequence[Event], gpus: set[int]) -> list[Event]:
    """The events on the streams of these devices; their other threads sum them up."""
    threads = {key: name for key, name in _names(events, "thread_name").items() if key[0] in gpus}
    streams = {key for key, name in threads.items() if name.startswith("Stream")}
    found = [event for event in events if event.get("ph") == "X" and (event["pid"], event["tid"]) in streams]
    if not found:
        raise RuntimeError(f"the profile has no stream of the GPU, but {', '.join(sorted({*threads.values()})) or '-'}")
    return found
