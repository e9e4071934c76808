"""The steps after which the tabular study measures."""

import numpy as np
import pytest

from experiments.theorem import study


def test_measurements_are_even_in_the_logarithm_and_end_with_the_last_step():
    for steps in (100, 101, 3000, 200_000):
        found = study.measuring_steps(steps)
        assert found[0] == 100 and found[-1] == steps and (np.diff(found) > 0).all()
    ratios = np.diff(np.log(study.measuring_steps(100_000)))
    assert ratios == pytest.approx(np.log(10) / 8, rel=0.02)
