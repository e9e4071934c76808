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
    rates = []
    for found in tried_in_turns(runs, seconds, repeats):
        if isinstance(found, Exception):
            raise found
        rates.append(found)
    return rates


def tried_in_turns(
    runs: Sequence[Callable[[int], Any]], seconds: float, repeats: int
) -> list[tuple[float, float] | Exception]:
    """`measure_in_turns`, but that one that raises drops out: what it raised stands in its place."""
    failed: dict[int, Exception] = {}

    def each(function: Callable[[int], Any]) -> dict[int, Any]:
        """Of the runs that are left."""
        found = {}
        for index in range(len(runs)):
            if index not in failed:
                try:
                    found[index] = function(index)
                except Exception as error:
                    failed[index] = error.with_traceback(None)  # it would keep the arrays that were in use
        return found

    def timed(index: int, iterations: int) -> float:
        start = time.perf_counter()
        jax.block_until_ready(runs[index](iterations))
        return time.perf_counter() - start

    def iterations_of(index: int) -> int:
        """How many take about `seconds`."""
        iterations = 1
        while (elapsed := timed(index, iterations)) < seconds / 4:
            iterations = min(iterations * 10, max(iterations + 1, int(iterations * seconds / max(elapsed, 1e-9))))
        return max(1, round(iterations * seconds / elapsed))

    compile_seconds = each(lambda index: timed(index, 1))
    counts = each(iterations_of)
    rates = [each(lambda index: counts[index] / timed(index, counts[index])) for _ in range(repeats)]
    return [
        failed[index] if index in failed else (statistics.median(rate[index] for rate in rates), compile_seconds[index])
        for index in range(len(runs))
    ]
