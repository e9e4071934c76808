"""Learning curves of an algorithm on an MDP: measurements over the steps, and their statistics over seeds."""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from scipy import stats

from experiments.theorem.q_learning import Measurements

Names = tuple[str, str]  # MDP, algorithm


class LearningCurves(NamedTuple):
    """One algorithm on one MDP."""

    coefs: tuple[float | None, ...]  # [K]; None: the algorithm has none
    steps: np.ndarray  # [C], after which was measured
    record: Measurements  # leaves [seeds, K, C]
    tables: np.ndarray  # [seeds, K, N, S, A], at the end


def interval(values: np.ndarray) -> tuple[float, float]:
    """The mean of `values` [seeds] and the half width of its 95 % t interval.

    The width comes from the std with ddof 1 and is NaN for one seed.
    """
    if len(values) < 2:
        return float(np.mean(values)), math.nan
    width = stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values))
    return float(np.mean(values)), float(width)


def tenth(steps: np.ndarray) -> int:
    """The index of the measurement nearest to a tenth of the steps."""
    return int(np.abs(np.log(steps / (0.1 * steps[-1]))).argmin())


def rows(results: Mapping[Names, LearningCurves]) -> Iterator[tuple[Names, int, LearningCurves]]:
    """An entry per algorithm, MDP and coefficient: the names, the coefficient's index and the curves."""
    for names, curves in results.items():
        for index in range(len(curves.coefs)):
            yield names, index, curves


def collapsed(curves: LearningCurves) -> bool:
    """Whether an algorithm gave exactly the same results with all of its several coefficients."""
    same = all(bool((leaf == leaf[:, :1]).all()) for leaf in curves.record[:-1])
    return len(curves.coefs) > 1 and same and bool((curves.tables == curves.tables[:, :1]).all())


def bias_during_learning(curves: LearningCurves, index: int) -> np.ndarray:
    """The bias during learning, [seeds]: its mean over the measurements, which are evenly spaced in log(steps)."""
    return np.asarray(curves.record.bias)[:, index].mean(axis=-1)


def row_name(names: Names, coef: float | None) -> str:
    """`grid, sqt 0.5`."""
    return ", ".join(names) + ("" if coef is None else f" {coef:g}")


def signed(mean: float, width: float) -> str:
    """`+0.385 ± 0.040`; without the half width where it is NaN."""
    return f"{mean:+.3f}" + ("" if math.isnan(width) else f" ± {width:.3f}")
