"""The ratio of two measurements that were timed in turns."""

import statistics

from scipy import stats

from experiments.benchmarks.measurements import Measurement

FEWEST = 6  # repeats for an interval: of fewer, no two have the median between them with 95 %


def ratio_text(ours: Measurement, theirs: Measurement) -> str:
    """The median over the repeats of ours / theirs, and the 95 % interval of that median: `1.20 (1.17 to 1.24)`.

    The interval is between two of the ratios, from the binomial distribution
    (https://docs.scipy.org/doc/scipy/reference/generated/scipy.stats.quantile_test.html). With fewer than `FEWEST`
    repeats there is none; without repeats the ratio is that of the rates.
    """
    ratios = [a / b for a, b in zip(ours.rates, theirs.rates, strict=False)]
    if not ratios or len(ours.rates) != len(theirs.rates):
        return f"{ours.rate / theirs.rate:.2f}"
    text = f"{statistics.median(ratios):.2f}"
    if len(ratios) < FEWEST:
        return text
    low, high = stats.quantile_test(ratios, p=0.5).confidence_interval(0.95)
    return f"{text} ({low:.2f} to {high:.2f})"
