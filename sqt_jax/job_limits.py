"""The limits of this process: the cores and the memory that its job, container or shell allows.

Control groups: https://docs.kernel.org/admin-guide/cgroup-v2.html and cgroup-v1/memory.html; `ulimit`: setrlimit(2).
"""

import math
import os
import re
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path("/")
ULIMITS = ((resource.RLIMIT_AS, "VmSize", "ulimit -v"), (resource.RLIMIT_DATA, "VmData", "ulimit -d"))
UNLIMITED_V1 = 2**62  # of version 1's memory.limit_in_bytes, rounded down to a page


class MemoryLimit(NamedTuple):
    """What is left under one limit."""

    left: int  # bytes
    name: str  # of the limit, for messages


def usable_cores(root: Path = ROOT) -> int:
    """The number of CPU cores that this process may use: its affinity, and the CPU quotas of its control groups.

    A quota of two and a half cores counts as three. Where the system says nothing, as on macOS: all of them.

    Args:
      root: where /proc and /sys are.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quotas = [quota for folder in _groups("cpu", root) if (quota := _cpu_quota(folder)) is not None]
    return max(1, min([cores, *(math.ceil(quota) for quota in quotas)]))


def memory_limits(root: Path = ROOT) -> list[MemoryLimit]:
    """The limits on this process's memory: of its control groups, `ulimit -v` and `ulimit -d`."""
    found = [limit for folder in _groups("memory", root) for limit in _group_memory(folder)]
    used = _process_memory(root)
    for kind, field, name in ULIMITS:
        soft, _ = resource.getrlimit(kind)
        if soft != resource.RLIM_INFINITY:
            found.append(MemoryLimit(max(0, soft - used.get(field, 0)), name))
    return found


def _groups(controller: str, root: Path) -> Iterator[Path]:
    """The folders of this process's control groups, from its own to the outermost: limits of all of them apply."""
    mounted = root / "sys/fs/cgroup"
    for line in _lines(root / "proc/self/cgroup"):
        _, controllers, path = line.split(":", 2) if line.count(":") >= 2 else ("", "", "")
        if controllers:
            names = controllers.split(",")
            tops = [mounted / controllers, mounted / controller] if controller in names else []
        else:
            tops = [mounted / "unified", mounted]  # beside version 1, or alone
        top = next((folder for folder in tops if folder.is_dir()), None)
        if top is None:
            continue
        # A container may see its groups under another path than the system's.
        parts = [part for part in path.split("/") if part not in ("", "..")]
        for length in range(len(parts), -1, -1):
            folder = top.joinpath(*parts[:length])
            if folder.is_dir():
                yield folder


def _cpu_quota(folder: Path) -> float | None:
    """Cores per group; None: no quota."""
    quota, period = (_text(folder / "cpu.max").split() + ["", ""])[:2]
    if not quota:
        quota, period = _text(folder / "cpu.cfs_quota_us"), _text(folder / "cpu.cfs_period_us")
    return int(quota) / int(period) if quota.isdecimal() and period.isdecimal() and int(period) else None


def _group_memory(folder: Path) -> Iterator[MemoryLimit]:
    current, key = _text(folder / "memory.current"), "inactive_file"
    names = ["memory.max", "memory.high"]
    if not current:
        current, key = _text(folder / "memory.usage_in_bytes"), "total_inactive_file"
        names = ["memory.limit_in_bytes"]
    cached = re.search(rf"^{key} (\d+)$", _text(folder / "memory.stat"), re.MULTILINE)
    used = (int(current) if current.isdecimal() else 0) - (int(cached[1]) if cached else 0)
    for name in names:
        limit = _text(folder / name)
        if limit.isdecimal() and int(limit) < UNLIMITED_V1:
            yield MemoryLimit(max(0, int(limit) - used), f"{name} of the control group {folder.name}")


def _process_memory(root: Path) -> dict[str, int]:
    """Bytes by the names of /proc/self/status."""
    matches = (re.fullmatch(r"(Vm\w+):\s+(\d+) kB", line) for line in _lines(root / "proc/self/status"))
    return {match[1]: 1024 * int(match[2]) for match in matches if match}


def _lines(path: Path) -> list[str]:
    return _text(path).splitlines()


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except (OSError, UnicodeDecodeError):
        return ""
