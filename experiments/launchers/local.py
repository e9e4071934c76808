"""`--launcher=local`: cells as processes of this machine, each with GPUs or cores of its own."""

import os
import shutil
import signal
import subprocess
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from experiments.commandline.arguments import FAILED, INTERRUPTED, UsageError
from experiments.launchers.cell import Cell, Ended
from experiments.launchers.cell_process import CellProcess

POLL_SECONDS = 0.1


class Share(NamedTuple):
    """A worker's part of the machine."""

    cores: tuple[int, ...] = ()  # empty: all
    gpus: tuple[str, ...] | None = None  # as in CUDA_VISIBLE_DEVICES; None: as in this process

    @property
    def variables(self) -> dict[str, str]:
        """Of the worker's environment."""
        return {} if self.gpus is None else {"CUDA_VISIBLE_DEVICES": ",".join(self.gpus)}


class LocalLauncher:
    """Runs one cell per share at a time.

    Args:
      start: starts a cell's process on a share.
    """

    def __init__(self, shares: Sequence[Share], start: Callable[..., Any] = CellProcess):
        self._free = list(shares)
        self._start = start
        self._waiting: deque[Cell] = deque()
        self._running: dict[Cell, tuple[Any, Share]] = {}
        self._over: list[Ended] = []  # without a process
        self._cancelled = False

    def submit(self, cells: Sequence[Cell]) -> None:
        """As `Launcher.submit`."""
        self._waiting += cells
        self._fill()

    def ended(self) -> list[Ended]:
        """As `Launcher.ended`."""
        found, self._over = self._over, []
        give_up = time.monotonic() + 1.0
        while not found and self._running and time.monotonic() < give_up:
            time.sleep(POLL_SECONDS)
            for cell, (process, share) in [*self._running.items()]:
                if ended := process.wait(0):
                    del self._running[cell]
                    self._free.append(share)
                    found.append(ended)
        self._fill()
        return found

    def cancel(self) -> None:
        """As `Launcher.cancel`."""
        self._over += [Ended(cell, INTERRUPTED, "not started") for cell in self._waiting]
        self._waiting.clear()
        for process, _ in self._running.values():
            process.send_signal(signal.SIGKILL if self._cancelled else signal.SIGTERM)
        self._cancelled = True

    def _fill(self) -> None:
        while self._free and self._waiting:
            cell, share = self._waiting.popleft(), self._free[0]
            try:
                self._running[cell] = (self._start(cell, share.cores, share.variables), share)
                del self._free[0]
            except OSError as error:
                self._over.append(Ended(cell, FAILED, f"cannot be started: {error}"))

    def __enter__(self) -> "LocalLauncher":
        return self

    def __exit__(self, *error: object) -> None:
        for process, _ in self._running.values():
            process.send_signal(signal.SIGKILL)
            process.wait()


def make(workers: int) -> LocalLauncher:
    """The launcher of `--launcher=local --workers=N`. Raises `UsageError` if there are fewer GPUs, or cores, than N."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    return LocalLauncher(shares(workers, cores, visible_gpus(os.environ)))


def shares(workers: int, cores: Sequence[int], gpus: Sequence[str]) -> list[Share]:
    """The machine in `workers` equal parts; what is left over goes to the first ones. One worker has all of it.

    Args:
      cores, gpus: those of this process; no cores: the system cannot give them to a process (macOS).

    Raises:
      UsageError: there are too few.
    """
    if workers == 1:
        return [Share()]
    unit, count = ("GPUs", len(gpus)) if gpus else ("cores", len(cores) or os.cpu_count() or 1)
    if workers > count:
        raise UsageError(f"--workers={workers}: expects at most {count}, the number of {unit} here")
    # Neighbours share caches: a worker's cores are next to each other.
    return [
        Share(_part(cores, index, workers), _part(gpus, index, workers) if gpus else None) for index in range(workers)
    ]


def _part(items: Sequence[Any], index: int, parts: int) -> tuple[Any, ...]:
    size, more = divmod(len(items), parts)
    begin = index * size + min(index, more)
    return tuple(items[begin : begin + size + (index < more)])


def visible_gpus(variables: Mapping[str, str]) -> list[str]:
    """The NVIDIA GPUs that JAX would use, as in CUDA_VISIBLE_DEVICES; empty where it computes on the CPU."""
    platforms = variables.get("JAX_PLATFORMS", "")
    if platforms and not {"cuda", "gpu"} & set(platforms.split(",")):
        return []
    if "CUDA_VISIBLE_DEVICES" in variables:
        return [name for name in variables["CUDA_VISIBLE_DEVICES"].split(",") if name.strip() not in ("", "-1")]
    if not shutil.which("nvidia-smi"):
        return []
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.SubprocessError):
        return []
    return [str(index) for index, line in enumerate(listed.stdout.splitlines()) if line.startswith("GPU ")]
