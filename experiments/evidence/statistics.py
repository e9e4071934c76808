"""Statistics of a few runs: the paper's score, and those of Agarwal et al. 2021 (https://arxiv.org/abs/2108.13264).

A stratum is the values of one algorithm on one task, `[..., seeds]`: seeds lie along the last axis.
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
    evaluation: int  # which one it is


class Interval(NamedTuple):
    low: np.ndarray
    high: np.ndarray


def score(returns: np.ndarray) -> Score | None:
    """Score of `returns` [seeds, evaluations]; evaluations with a NaN do not count. None if there is no other."""
    mean = returns.mean(axis=0)
    if not np.isfinite(mean).any():
        return None
    best = int(np.nanargmax(np.where(np.isfinite(mean), mean, np.nan)))
    return Score(float(mean[best]), float(returns[:, best].std()), best)


def mean(*strata: np.ndarray) -> np.ndarray:
    """Mean over strata of the mean over seeds: each task weighs the same, however many seeds it has."""
    return np.mean([stratum.mean(axis=-1) for stratum in strata], axis=0)


def iqm(*strata: np.ndarray) -> np.ndarray:
    """Interquartile mean of all values together: a quarter of them, rounded down, is left out at each end.

    NaN where there is a NaN among them, which would otherwise be left out as if it were large.
    """
    values = np.sort(np.concatenate(strata, axis=-1), axis=-1)
    count = values.shape[-1]
    cut = count // 4
    return np.where(np.isnan(values[..., -1]), np.nan, values[..., cut : count - cut].mean(axis=-1))


def probability_of_improvement(*strata: np.ndarray) -> np.ndarray:
    """P(X > Y) of `x, y` of a task, then of the next task, and so on: the mean over tasks. A tie counts one half."""
    over_tasks = []
    for x, y in zip(strata[::2], strata[1::2], strict=True):
        x, y = x[..., :, None], y[..., None, :]
        over_tasks.append(((x > y) + 0.5 * (x == y)).mean(axis=(-2, -1)))
    return np.mean(over_tasks, axis=0)


def improvement(*strata: np.ndarray) -> np.ndarray:
    """By how many per cent the mean of X exceeds Y's, the mean over tasks; `x, y` of a task, then of the next.

    NaN where a mean of Y is not positive: a percentage of it would say nothing.
    """
    over_tasks = []
    for x, y in zip(strata[::2], strata[1::2], strict=True):
        base = y.mean(axis=-1)
        base = np.where(base > 0, base, np.nan)
        over_tasks.append(100 * (x.mean(axis=-1) - base) / base)
    return np.mean(over_tasks, axis=0)


def exceeds(values: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """[thresholds, seeds]: 1.0 where a value lies above a threshold. Their `mean` is the performance profile."""
    return (values[None, :] > thresholds[:, None]).astype(float)


def bootstrap(
    statistic: Callable[..., np.ndarray],
    *strata: np.ndarray,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> Interval:
    """Percentile interval of `statistic(*strata)`: the seeds of each stratum are drawn anew with replacement.

    Strata are drawn independently of each other; what lies along their leading axes is drawn together. The same
    `seed` gives the same interval. NaN where the statistic is NaN for some draw.
    """
    generator = np.random.default_rng(seed)
    drawn = []
    for stratum in strata:
        count = stratum.shape[-1]
        drawn.append(stratum[..., generator.integers(count, size=(resamples, count))])
    tail = (1 - confidence) / 2
    return Interval(*np.quantile(statistic(*drawn), [tail, 1 - tail], axis=-1))
