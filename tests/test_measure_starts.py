"""The suite starts: the same command twice, with one compilation cache."""

import sys

from experiments.benchmarks import measure_starts
from experiments.benchmarks.measurements import SECONDS


def test_the_second_start_has_the_cache_that_the_first_left():
    calls, times = [], iter([0.0, 40.0, 40.0, 45.5])
    found = measure_starts.bench_starts(
        "td3", "ant", 2, "mjx", run=lambda *call: calls.append(call), clock=lambda: next(times)
    )
    cold, warm = found
    assert cold.figure == ("40", SECONDS) and warm.figure == ("5.5", SECONDS)
    assert (cold.what, warm.what) == ("td3 on ant, mjx, cold", "td3 on ant, mjx, warm")
    (first, first_variables), (second, second_variables) = calls
    assert first[:3] == [sys.executable, "-m", "experiments.run"] and "--seeds=0,1" in first
    assert [a for a, b in zip(first, second, strict=True) if a != b] == [next(a for a in first if "--out=" in a)]
    assert first_variables["JAX_COMPILATION_CACHE_DIR"] == second_variables["JAX_COMPILATION_CACHE_DIR"]
