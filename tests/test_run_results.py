"""Comparing the results of runs."""

import numpy as np

from experiments.endurance.run_results import differences


def test_the_smallest_difference_is_found():
    one = {"a": np.zeros(3, np.float32), "metrics": [{"q_mean": "1.5"}]}
    assert differences(one, one) == []
    nearly = one | {"a": np.array([0, 0, np.nextafter(np.float32(0), np.float32(1))], np.float32)}
    assert differences(one, nearly) == ["a"]
    assert differences(one, one | {"a": -one["a"]}) == ["a"]  # -0.0
    assert differences(one, one | {"metrics": []}) == ["metrics"]
    assert differences(one, {"a": one["a"]}) == ["metrics"]
