"""The suite gpu: everything to be known about a GPU in 15 minutes, most telling first: `bench --suite=gpu`.

Each part runs in a process of its own (`gpu_process`), for its number of seconds at most: 9 minutes for loops, parity
and profile together. All parts share a number of minutes; those at the end are left out when it has passed. Nothing of
this has run on a GPU yet: the limits are estimates, and a row per part says how many seconds it took.
"""

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from experiments.benchmarks import part_process
from experiments.benchmarks.measurements import SECONDS, Failure, Measurement
from experiments.surroundings.gpu_options import DETERMINISTIC, GRAPHS_IN_PROFILES, OPTIONS, with_flags

# --parts, in the order in which they are made
PARTS = ("loops", "parity", "profile", "td7", "exact", "options", "more_parity")
PHYSICS = ("warp", "mjx", "mujoco")  # the first one, of those asked for, is that of most parts
# Of exact resume, the first two. MuJoCo Warp orders contacts by atomic additions, so its sums may vary.
EXACT_PHYSICS = ("mjx", "warp", "mujoco")
MORE_TASKS = {"cheetah": 90, "humanoid": 200}  # of more_parity, with limits: Warp compiles kernels for each
ALGO, SECOND_ALGO = "td3_sqt", "td7_sqt"
MINUTES = 13.0  # of all parts together
SHORTEST = 15  # seconds; a part that has less is not begun


class Part(NamedTuple):
    """A process of the suite."""

    kind: str  # of `gpu_process`
    arguments: dict[str, Any]
    limit: int  # seconds
    flags: str = ""  # further words of XLA_FLAGS

    @property
    def what(self) -> str:
        """Its name in a failure."""
        case = [str(self.arguments[name]) for name in ("algo", "task", "physics", "members") if name in self.arguments]
        return f"{self.kind}: {', '.join(case)}{self.arguments.get('label', '')}"


def parts_of(
    names: Sequence[str], task: str, members: Sequence[int], physics: Sequence[str], **timing: Any
) -> list[Part]:
    """The processes of these parts, in order.

    Args:
      members: up to three numbers: of all parts, of the largest loop of MuJoCo C, and of Warp's.
      physics: some of `PHYSICS`.
      timing: `seconds` and `repeats` of `timing.measure`.
    """
    few, more, most = [*members, members[-1], members[-1]][:3]
    here = [name for name in PHYSICS if name in physics]
    main = here[0]

    def loop(algo: str, name: str, count: int, limit: int, label: str = "", flags: str = "") -> Part:
        case = {"algo": algo, "task": task, "physics": name, "members": count}
        return Part("loop", {**case, **({"label": label} if label else {}), **timing}, limit, flags)

    case = {"algo": ALGO, "task": task, "physics": main, "members": few}
    numbers = {"warp": (few, most), "mjx": (few,), "mujoco": (few, more)}
    limits = {"warp": (180, 60), "mjx": (100,), "mujoco": (35, 35)}  # the first one compiles Warp's kernels too
    deterministic = ", deterministic kernels"
    exact = [{**case, "physics": name} for name in EXACT_PHYSICS if name in here][:2]
    made: dict[str, list[Part]] = {
        "loops": [
            loop(ALGO, name, count, limit)
            for name in here
            for count, limit in dict(zip(numbers[name], limits[name], strict=True)).items()
        ],
        "parity": [Part("parity", {"task": task, "physics": main}, 45)],
        "profile": [
            Part("profile", case, 40),
            Part("profile", {**case, "label": ", with graphs"}, 40, GRAPHS_IN_PROFILES),
        ],
        "td7": [loop(SECOND_ALGO, main, few, 100)],
        "exact": [
            loop(ALGO, main, few, 60, deterministic, DETERMINISTIC),
            *(Part("exact", {**one, "label": deterministic}, 240, DETERMINISTIC) for one in exact),
            Part("exact", exact[0], 240),
        ],
        "options": [
            loop(ALGO, physics, few, limit, f", {name}: {OPTIONS[name].what}", OPTIONS[name].flags)
            for physics, name, limit in _with_options(here)
        ],
        "more_parity": [
            Part("parity", {"task": name, "physics": main}, limit) for name, limit in MORE_TASKS.items() if name != task
        ],
    }
    return [part for name in PARTS if name in names for part in made[name]]


def _with_options(physics: Sequence[str]) -> list[tuple[str, str, int]]:
    """(physics, option, limit) of the loops with an option: all options on the first physics. Before them graphs of
    loops on mjx: most of the loops that wait for the host are its solver's."""
    mjx = [("mjx", "loops", 100)] if "mjx" in physics[1:] else []
    return mjx + [(physics[0], name, 60) for name in OPTIONS]


def bench_gpu(
    parts: Sequence[Part],
    patience: float = 1.0,
    minutes: float = MINUTES,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Measurement | Failure]:
    """The measurements of all processes, one process after the other, and the seconds that each process took. One that
    fails, or that no time is left for, yields a `Failure`.

    Args:
      patience: factor of the parts' limits of time.
      minutes: of all parts together.
      clock: seconds.
    """
    end = clock() + 60 * minutes
    for part in parts:
        start = clock()
        limit = min(patience * part.limit, end - start)
        if limit < min(SHORTEST, patience * part.limit):
            yield Failure(part.what, f"it was not begun: the {minutes:g} minutes of all parts had passed")
            continue
        command = [sys.executable, "-m", "experiments.benchmarks.gpu_process", part.kind, json.dumps(part.arguments)]
        yield from part_process.results(command, part.what, limit, with_flags(os.environ, part.flags))
        what, members = f"{part.what}, of {limit:.0f} s", part.arguments.get("members", 1)
        yield Measurement(suite="seconds", what=what, members=members, unit=SECONDS, rate=clock() - start)
