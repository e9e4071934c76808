"""Statistics of the tabular learning curves."""

import numpy as np
import pytest
from made_curves import curves

from experiments.theorem.learning_curves import bias_during_learning, collapsed, interval, signed, tenth


def test_the_interval_is_students():
    # mean 2, std 1, four seeds: 3.182 / 2
    mean, width = interval(np.array([1.0, 1.0, 3.0, 3.0]) * 3**0.5 / 2)
    assert mean == pytest.approx(3**0.5) and width == pytest.approx(3.182446 / 2, rel=1e-5)


def test_the_bias_during_learning_is_the_mean_over_measurements():
    found = curves((0.0, 0.5), 2, bias=(3.0, 1.0, 2.0), seeds=2)
    assert tenth(found.steps) == 1
    np.testing.assert_allclose(bias_during_learning(found, 1), [2.0, 2.02])
    assert collapsed(found) and not collapsed(curves(bias=1.0))
    assert (signed(0.5, 0.25), signed(-0.5, np.nan)) == ("+0.500 ± 0.250", "-0.500")
