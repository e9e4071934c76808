"""Loops are measured together, or one after the other if they need too much memory."""

import weakref

import pytest

from experiments.benchmarks import measure_loops
from experiments.benchmarks.measurements import Prepared

SHORT = {"seconds": 0.0, "repeats": 1}


@pytest.mark.parametrize(("limit", "most"), [(0, 1), (1e12, 3)])
def test_large_loops_are_in_memory_one_at_a_time(monkeypatch, limit, most):
    class State:
        """The arrays of a loop."""

    alive, counts = weakref.WeakSet(), []

    def loop_steps(algo, task, members, physics, devices):
        state = State()
        alive.add(state)

        def run(steps, state=state):
            counts.append(len(alive))
            if physics == "b":
                raise MemoryError(physics)

        return Prepared(run, compile_seconds=1.0)

    monkeypatch.setattr(measure_loops, "MAX_INTERLEAVED_BYTES", limit)
    monkeypatch.setattr(measure_loops, "loop_steps", loop_steps)
    first, failed, last = measure_loops.bench_loops("td3", "cheetah", 5, ["a", "b", "c"], **SHORT)
    assert max(counts) == most and not alive
    assert (first.what, failed.what, last.what) == (
        "td3 on cheetah, a",
        "loop: td3 on cheetah, b, 5 members",
        "td3 on cheetah, c",
    )
