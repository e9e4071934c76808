"""Statistics over few seeds: the paper's score, and those of Agarwal et al. 2021 (https://arxiv.org/abs/2108.13264).

A stratum is the values of one algorithm on one task, [..., seeds]: seeds are the last axis. Stds have ddof 0
(population).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

RESAMPLES = 2000
CONFIDENCE = 0.95


class Score(NamedTuple):
    """The paper's "maximum average reward": the best evaluation of the mean over seeds."""

    mean: float
    std: float  # population std over the seeds, at that evaluation
    evaluation: int  # its index


class Interval(NamedTuple):
    """An interval's ends, [...] each."""

    low: np.ndarray
    high: np.ndarray


def score(returns: np.ndarray) -> Score | None:
    """Score of `returns` [seeds, evaluations]. Evaluations with a NaN do not count; None if none counts."""
    mean = returns.mean(axis=0)
    if not np.isfinite(mean).any():
        return None
    best = int(np.nanargmax(np.where(np.isfinite(mean), mean, np.nan)))
    return Score(float(mean[best]), float(returns[:, best].std()), best)


def mean(*strata: np.ndarray) -> np.ndarray:
    """Mean over strata of the mean over seeds, [...]: each task has the same weight, however many seeds it has."""
    return np.mean([stratum.mean(axis=-1) for stratum in strata], axis=0)


def iqm(*strata: np.ndarray) -> np.ndarray:
    """Interquartile mean of all values together, [...]: a quarter of them, rounded down, is left out at each end.

    NaN where any value is NaN; sorting would otherwise treat it as the largest value and leave it out.
    """
    values = np.sort(np.concatenate(strata, axis=-1), axis=-1)
    count = values.shape[-1]
    cut = count // 4
    return np.where(np.isnan(values[..., -1]), np.nan, values[..., cut : count - cut].mean(axis=-1))


def probability_of_improvement(*strata: np.ndarray) -> np.ndarray:
    """P(X > Y), the mean over tasks, [...]. A tie counts one half.

    Args:
      strata: `x, y` of the first task, then of the next, [..., seeds] each.
    """
    over_tasks = []
    for x, y in zip(strata[::2], strata[1::2], strict=True):
        x, y = x[..., :, None], y[..., None, :]
        over_tasks.append(((x > y) + 0.5 * (x == y)).mean(axis=(-2, -1)))
    return np.mean(over_tasks, axis=0)


def improvement(*strata: np.ndarray) -> np.ndarray:
    """By how many per cent the mean of X exceeds that of Y, the mean over tasks, [...].

    NaN where a mean of Y is not positive, because a percentage would be meaningless.

    Args:
      strata: `x, y` of the first task, then of the next, [..., seeds] each.
    """
    over_tasks = []
    for x, y in zip(strata[::2], strata[1::2], strict=True):
        other = y.mean(axis=-1)
        other = np.where(other > 0, other, np.nan)
        over_tasks.append(100 * (x.mean(axis=-1) - other) / other)
    return np.mean(over_tasks, axis=0)


def exceeds(values: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """1.0 where a value is above a threshold, [thresholds, seeds]. Their `mean` is the performance profile.

    Args:
      values: [seeds].
      thresholds: [thresholds].
    """
    return (values[None, :] > thresholds[:, None]).astype(float)


def bootstrap(
    statistic: Callable[..., np.ndarray],
    *strata: np.ndarray,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> Interval:
    """Percentile bootstrap interval of `statistic(*strata)`: the seeds of each stratum are resampled with replacement.

    Strata are resampled independently; the leading axes of a stratum use the same draws. The same `seed` gives the same
    interval. NaN where the statistic is NaN for a resample.
    """
    generator = np.random.default_rng(seed)
    drawn = []
    for stratum in strata:
        count = stratum.shape[-1]
        drawn.append(stratum[..., generator.integers(count, size=(resamples, count))])
    tail = (1 - confidence) / 2
    return Interval(*np.quantile(statistic(*drawn), [tail, 1 - tail], axis=-1))
