"""How often per second a compiled loop goes round."""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax


def measure(run: Callable[[int], Any], seconds: float, repeats: int) -> tuple[float, float]:
    """Iterations per second of `run(iterations)` (median), and the seconds of the first call, which compiles."""
    return measure_in_turns([run], seconds, repeats)[0]


def measure_in_turns(runs: Sequence[Callable[[int], Any]], seconds: float, repeats: int) -> list[tuple[float, float]]:
    """`measure` of each, one timed call of every one in turn: a machine that slows down does so for all of them."""

    def timed(run: Callable[[int], Any], iterations: int) -> float:
        start = time.perf_counter()
        jax.block_until_ready(run(iterations))
        return time.perf_counter() - start

    compile_seconds = [timed(run, 1) for run in runs]
    counts = []
    for run in runs:
        iterations = 1
        while (elapsed := timed(run, iterations)) < seconds / 4:
            iterations = min(iterations * 10, max(iterations + 1, int(iterations * seconds / max(elapsed, 1e-9))))
        counts.append(max(1, round(iterations * seconds / elapsed)))
    rates = [[count / timed(run, count) for run, count in zip(runs, counts, strict=True)] for _ in range(repeats)]
    return list(zip(map(statistics.median, zip(*rates, strict=True)), compile_seconds, strict=True))
