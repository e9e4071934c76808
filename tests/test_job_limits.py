"""Cores and memory that a job may use, read from files of control groups and from `ulimit`."""

import os
import resource

import pytest

from sqt_jax import job_limits
from sqt_jax.job_limits import memory_limits, usable_cores


@pytest.fixture
def unlimited(monkeypatch):
    """A process that may use 8 cores and any memory."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def system(root, **files):
    """The files below `root`, by path."""
    for name, text in files.items():
        file = root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return root


def test_all_cores_count_if_the_system_does_not_limit_them(monkeypatch, tmp_path):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert usable_cores(tmp_path) == os.cpu_count()


def test_cores_that_the_process_may_not_use_do_not_count(monkeypatch, tmp_path):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {1, 5, 7}, raising=False)
    assert usable_cores(tmp_path) == 3


V2 = "sys/fs/cgroup/"
CPU_V1 = "sys/fs/cgroup/cpu,cpuacct/"


@pytest.mark.parametrize(
    ("groups", "files", "cores"),
    [
        ("0::/\n", {}, 8),
        ("0::/\n", {V2 + "cpu.max": "max 100000"}, 8),
        ("0::/\n", {V2 + "cpu.max": "250000 100000"}, 3),
        ("0::/\n", {V2 + "cpu.max": "5000 100000"}, 1),
        ("0::/\n", {V2 + "cpu.max": "1600000 100000"}, 8),
        # The smallest quota of the group and those around it counts.
        ("0::/a/b\n", {V2 + "a/cpu.max": "200000 100000", V2 + "a/b/cpu.max": "max 100000"}, 2),
        # A container whose group has another path inside.
        ("0::/../host/job\n", {V2 + "cpu.max": "400000 100000"}, 4),
        ("4:cpu,cpuacct:/job\n", {CPU_V1 + "job/cpu.cfs_quota_us": "150000", CPU_V1 + "job/cpu.cfs_period_us": "50000"},
         3),  # fmt: skip
        ("4:cpu,cpuacct:/job\n", {CPU_V1 + "job/cpu.cfs_quota_us": "-1", CPU_V1 + "job/cpu.cfs_period_us": "50000"}, 8),
        ("", {V2 + "cpu.max": "100000 100000"}, 8),
        ("nonsense\n0::/\n", {V2 + "cpu.max": "nonsense"}, 8),
    ],
)  # fmt: skip
def test_quotas_of_control_groups(unlimited, tmp_path, groups, files, cores):
    assert usable_cores(system(tmp_path, **{"proc/self/cgroup": groups}, **files)) == cores


MEMORY_V1 = "sys/fs/cgroup/memory/"
A_V1, B_V1 = MEMORY_V1 + "a/memory.", MEMORY_V1 + "a/b/memory."


@pytest.mark.parametrize(
    ("groups", "files", "left"),
    [
        ("0::/\n", {V2 + "memory.max": "max", V2 + "memory.current": "10"}, []),
        ("0::/\n", {V2 + "memory.max": "1000", V2 + "memory.current": "300"}, [700]),
        # Pages of files can be taken back.
        ("0::/\n", {V2 + "memory.max": "1000", V2 + "memory.current": "300",
                    V2 + "memory.stat": "anon 100\ninactive_file 120\n"}, [820]),  # fmt: skip
        ("0::/\n", {V2 + "memory.max": "1000", V2 + "memory.high": "800", V2 + "memory.current": "900"}, [100, 0]),
        ("0::/a/b\n", {V2 + "a/memory.max": "1000", V2 + "a/memory.current": "300", V2 + "a/b/memory.max": "max",
                       V2 + "a/b/memory.current": "200"}, [700]),  # fmt: skip
        ("7:memory:/a/b\n", {A_V1 + "limit_in_bytes": "1000", A_V1 + "usage_in_bytes": "300",
                             A_V1 + "stat": "total_inactive_file 50\n",
                             B_V1 + "limit_in_bytes": "9223372036854771712",
                             B_V1 + "usage_in_bytes": "300"}, [750]),  # fmt: skip
        ("9:cpuset:/\n", {V2 + "memory.max": "1000"}, []),
    ],
)  # fmt: skip
def test_memory_of_control_groups(unlimited, tmp_path, groups, files, left):
    limits = memory_limits(system(tmp_path, **{"proc/self/cgroup": groups}, **files))
    assert [limit.left for limit in limits] == left


def test_ulimit_counts_less_what_the_process_uses(monkeypatch, tmp_path):
    limits = {resource.RLIMIT_AS: 5000 * 1024, resource.RLIMIT_DATA: 100 * 1024}
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (limits[kind], resource.RLIM_INFINITY))
    root = system(tmp_path, **{"proc/self/status": "Name:\tpython\nVmSize:\t    2000 kB\nVmData:\t 300 kB\n"})
    assert memory_limits(root) == [
        job_limits.MemoryLimit(3000 * 1024, "ulimit -v"),
        job_limits.MemoryLimit(0, "ulimit -d"),
    ]
