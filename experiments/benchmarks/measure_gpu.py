"""The suite gpu: everything to be known about a GPU in 15 minutes, most telling first: `bench --suite=gpu`.

Each part runs in a process of its own (`gpu_process`), for its number of seconds at most: 10 minutes for loops, parity
and profile together. Nothing of this has run on a GPU yet: the limits are estimates.
"""

import json
import os
import sys
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from experiments.benchmarks import part_process
from experiments.benchmarks.measurements import Failure, Measurement
from experiments.surroundings.gpu_options import DETERMINISTIC, GRAPHS_IN_PROFILES, OPTIONS, with_flags

PARTS = ("loops", "parity", "profile", "options", "td7", "exact")  # --parts, in the order in which they are made
PHYSICS = ("warp", "mjx", "mujoco")  # the first one, of those asked for, is that of all parts but loops
PARITY_TASKS = ("cheetah", "ant", "humanoid")
ALGO, SECOND_ALGO = "td3_sqt", "td7_sqt"


class Part(NamedTuple):
    """A process of the suite."""

    kind: str  # of `gpu_process`
    arguments: dict[str, Any]
    limit: int  # seconds
    flags: str = ""  # further words of XLA_FLAGS

    @property
    def what(self) -> str:
        """Its name in a failure."""
        return f"{self.kind}: {', '.join(map(str, self.arguments.values()))}"


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
    limits = {"warp": (180, 60), "mjx": (90,), "mujoco": (40, 40)}  # the first one compiles Warp's kernels too
    made: dict[str, list[Part]] = {
        "loops": [
            loop(ALGO, name, count, limit)
            for name in here
            for count, limit in dict(zip(numbers[name], limits[name], strict=True)).items()
        ],
        "parity": [Part("parity", {"task": name, "physics": main}, 35) for name in PARITY_TASKS],
        "profile": [
            Part("profile", case, 40),
            Part("profile", {**case, "label": ", with graphs"}, 40, GRAPHS_IN_PROFILES),
        ],
        "options": [
            loop(ALGO, main, few, 60, f", {name}: {option.what}", option.flags) for name, option in OPTIONS.items()
        ],
        "td7": [loop(SECOND_ALGO, main, few, 120)],
        "exact": [
            loop(ALGO, main, few, 60, ", deterministic kernels", DETERMINISTIC),
            Part("exact", {**case, "label": ", deterministic kernels"}, 240, DETERMINISTIC),
            Part("exact", case, 240),
        ],
    }
    return [part for name in PARTS if name in names for part in made[name]]


def bench_gpu(parts: Sequence[Part], patience: float = 1.0) -> Iterator[Measurement | Failure]:
    """The measurements of all processes, one process after the other. One that fails yields a `Failure`.

    Args:
      patience: factor of the limits of time.
    """
    for part in parts:
        command = [sys.executable, "-m", "experiments.benchmarks.gpu_process", part.kind, json.dumps(part.arguments)]
        limit = patience * part.limit
        yield from part_process.results(command, part.what, limit, with_flags(os.environ, part.flags))
