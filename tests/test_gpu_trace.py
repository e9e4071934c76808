"""Counts of a GPU's work, from the profiler's events."""

import pytest

from experiments.benchmarks import gpu_trace

GPU, HOST = 1, 2


def named(kind, pid, tid, name):
    return {"ph": "M", "name": kind, "pid": pid, "tid": tid, "args": {"name": name}}


def event(pid, tid, name, length):
    return {"ph": "X", "pid": pid, "tid": tid, "ts": 0.0, "dur": length, "name": name}


NAMES = [
    named("process_name", GPU, 0, "/device:GPU:0 NVIDIA H100"),
    named("process_name", HOST, 0, "/host:CPU"),
    named("thread_name", GPU, 3, "Stream #13(Compute,MemcpyD2H)"),
    named("thread_name", GPU, 4, "XLA Ops"),
]


def test_work_on_streams_is_counted_by_kind():
    events = [
        *NAMES,
        *(event(GPU, 3, f"loop_fusion.{number}", 2e6) for number in (1, 2)),
        event(GPU, 3, "MemcpyD2H", 1e6),
        event(GPU, 3, "MemcpyD2D", 1e6),
        event(GPU, 3, "CudaGraphExec:7", 4e6),
        event(GPU, 4, "loop_fusion.1", 2e6),  # sums up
        *(event(HOST, 9, name, 1.0) for name in ("cuGraphLaunch", "cudaGraphLaunch", "cuLaunchKernel")),
    ]
    found = gpu_trace.count(events)
    assert (found.kernels, found.graphs, found.copies_to_host, found.seconds) == (2, 2, 1, 10.0)
    assert list(found.longest.items())[0] == ("loop_fusion", 0.4) and found.longest["CudaGraphExec:"] == 0.4


def test_graphs_are_found_on_the_device_where_the_host_lists_none():
    assert gpu_trace.count([*NAMES, event(GPU, 3, "CudaGraphExec:7", 4e6)]).graphs == 1


def test_a_trace_without_streams_says_what_it_has():
    with pytest.raises(RuntimeError, match="^the profile has no stream of the GPU, but Lines, XLA Ops$"):
        gpu_trace.count([*NAMES[:2], NAMES[3], named("thread_name", GPU, 5, "Lines"), event(GPU, 4, "a", 1.0)])


def test_without_a_gpu_the_operations_of_the_cpu_are_counted():
    events = [
        named("process_name", HOST, 0, "/host:CPU"),
        event(HOST, 1, "dot.3", 1e6) | {"args": {"hlo_op": "dot.3"}},
        event(HOST, 1, "python", 1e6),
    ]
    found = gpu_trace.count(events)
    assert (found.kernels, found.graphs, found.seconds, found.longest) == (1, 0, 1.0, {"dot": 1.0})
