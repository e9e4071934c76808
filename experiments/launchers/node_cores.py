"""Cores of a machine that processes of one user divide among them: a file and its lock for each core.

Ray counts CPUs but gives none to a task, and a run uses all cores that its process may use.
"""

import fcntl
import os
import random
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

BUSY_PERCENT = 50.0


@contextmanager
def reserved_cores(count: int, node_cpus: int, folder: Path | None = None) -> Iterator[tuple[int, ...]]:
    """Cores that no other context has: held until the context is left or its process ends.

    Where fewer are free than asked for, the rest are cores that others have too. Empty where the system cannot give
    cores to a process (macOS), and where this process has no more cores than asked for: all of them are used.

    Args:
      count: how many.
      node_cpus: how many CPUs the cluster counts on this machine. If the process may use more, others use them (more
        containers on one host), unseen from here: idle cores are taken first, from a random one on.
      folder: with the locks; by default one of the user's on this machine.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if len(cores) <= count:
        yield ()
        return
    if len(cores) > node_cpus:
        begin = random.randrange(len(cores))
        cores = _idle_first([*cores[begin:], *cores[:begin]])
    folder = folder or Path(tempfile.gettempdir()) / f"sqt_jax_cores_{os.getuid()}"
    locks: dict[int, int] = {}
    try:
        with suppress(OSError):  # without the folder no core is reserved
            folder.mkdir(mode=0o700, exist_ok=True)
            for core in cores:
                if len(locks) < count and (lock := _lock(folder / str(core))) is not None:
                    locks[core] = lock
        others = [core for core in cores if core not in locks]
        yield tuple(sorted([*locks, *others[: count - len(locks)]]))
    finally:
        for lock in locks.values():
            os.close(lock)


def _lock(path: Path) -> int | None:
    """The descriptor of a locked file; None if another process has locked it."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _idle_first(cores: Sequence[int]) -> list[int]:
    loads = psutil.cpu_percent(0.2, percpu=True)
    return sorted(cores, key=lambda core: core < len(loads) and loads[core] > BUSY_PERCENT)
