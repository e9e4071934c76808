"""Iterations per second of compiled loops."""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax


class Timed(NamedTuple):
    """A loop's timed calls."""

    rates: tuple[float, ...]  # iterations per second of each, in their order
    compile_seconds: float  # of the first call

    @property
    def rate(self) -> float:
        """Their median."""
        return statistics.median(self.rates)


def measure(run: Callable[[int], Any], seconds: float, repeats: int) -> tuple[float, float]:
    """Times one loop.

    Args:
      run: number of iterations -> arrays to wait for.
      seconds: approximate duration of one timed call.
      repeats: number of timed calls.

    Returns:
      Iterations per second (median of the timed calls), and the seconds of the first call, which compiles.

    Raises whatever `run` raises.
    """
    return measure_interleaved([run], seconds, repeats)[0]


def measure_interleaved(
    runs: Sequence[Callable[[int], Any]], seconds: float, repeats: int
) -> list[tuple[float, float]]:
    """`measure` of each run, with the timed calls interleaved: a change of the machine's speed affects all of them.

    Raises the first error that a run raised, after the others have been timed.
    """
    rates = []
    for found in rates_or_errors(runs, seconds, repeats):
        if isinstance(found, Exception):
            raise found
        rates.append((found.rate, found.compile_seconds))
    return rates


def rates_or_errors(runs: Sequence[Callable[[int], Any]], seconds: float, repeats: int) -> list[Timed | Exception]:
    """The timed calls of `measure_interleaved`, or the exception of a run, which is not called again after that."""
    failed: dict[int, Exception] = {}

    def for_each(function: Callable[[int], Any]) -> dict[int, Any]:
        """The function's results by index, for the runs that have not failed."""
        found = {}
        for index in range(len(runs)):
            if index not in failed:
                try:
                    found[index] = function(index)
                except Exception as error:
                    failed[index] = error.with_traceback(None)  # the traceback would keep the arrays in use alive
        return found

    def timed(index: int, iterations: int) -> float:
        start = time.perf_counter()
        jax.block_until_ready(runs[index](iterations))
        return time.perf_counter() - start

    def iterations_of(index: int) -> int:
        """The number of iterations that last about `seconds`."""
        iterations = 1
        while (elapsed := timed(index, iterations)) < seconds / 4:
            iterations = min(iterations * 10, max(iterations + 1, int(iterations * seconds / max(elapsed, 1e-9))))
        return max(1, round(iterations * seconds / elapsed))

    compile_seconds = for_each(lambda index: timed(index, 1))
    counts = for_each(iterations_of)
    rates = [for_each(lambda index: counts[index] / timed(index, counts[index])) for _ in range(repeats)]
    return [
        failed[index] if index in failed else Timed(tuple(rate[index] for rate in rates), compile_seconds[index])
        for index in range(len(runs))
    ]
