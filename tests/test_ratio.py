"""Ratios of measurements: medians, and intervals that hold the true median as often as they say."""

import numpy as np
import pytest

from experiments.benchmarks.measurements import Measurement
from experiments.benchmarks.ratio import FEWEST, ratio_text


def rated(*rates):
    return Measurement("loop", "td3", 5, "env steps", rate=float(np.median(rates)), rates=rates)


def test_the_ratio_is_the_median_of_the_repeats_own():
    """The machine is twice as slow in the second repeat, for both."""
    assert ratio_text(rated(12.0, 6.0, 13.0), rated(10.0, 5.0, 10.0)) == "1.20"


def test_the_interval_is_between_two_ratios():
    """Of nine, the second and the eighth: the median is outside with 2 × 10 / 512 = 4 %."""
    ratios = [1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7, 1.8]
    assert ratio_text(rated(*ratios), rated(*[1.0] * 9)) == "1.40 (1.10 to 1.70)"
    assert "(" in ratio_text(rated(*ratios[:FEWEST]), rated(*[1.0] * FEWEST))
    assert "(" not in ratio_text(rated(*ratios[: FEWEST - 1]), rated(*[1.0] * (FEWEST - 1)))


@pytest.mark.parametrize("theirs", [Measurement("loop", "td3", 5, "env steps", rate=4.0), rated(4.0, 4.0)])
def test_measurements_without_common_repeats_are_compared_by_their_rates(theirs):
    assert ratio_text(rated(8.0, 8.0, 9.0), theirs) == "2.00"
