"""The rows of the tables so far: those that TensorBoard got."""

import numpy as np
import pytest
from test_records import report

from experiments.running import records
from experiments.running.past_rows import past_rows
from experiments.running.run_config import make_members
from sqt_jax.experiment import make_config


class Kept:
    """Keeps the rows that it gets."""

    def __init__(self):
        self.rows = {}

    def add(self, rows, env_steps):
        self.rows[env_steps] = rows

    def close(self, exit_codes):
        pass


@pytest.mark.parametrize("swept", ["penalty_coef", "temperature", "lr"])
def test_they_are_what_was_sent(tmp_path, swept):
    members = make_members([3, 5], [make_config("sac_sqt", "ant", **{swept: value}) for value in (0.1, 0.2)])
    kept, metrics = Kept(), {"q_std": [0.1, np.nan, 1 / 3, 4.0], "temperature": [0.1, 0.1, 0.2, 0.2]}
    with records.Records(tmp_path, members, [swept], tensorboard=False) as tables:
        tables.track(kept)
        tables.report(report(0, [[1, 2], [5, 5], [0, 1], [7, 7]]))
        bias = {"value_bias": [-1.5, np.nan, 0.0, 2.0], "value_bias_min": [-2.0] * 4}
        tables.report(report(20, [[2, 4], [6, 8], [np.nan, np.nan], [1, 1]], metrics, **bias))
        tables.report(report(25, None, metrics))  # the interval that a signal cut short
        again = dict(past_rows(tmp_path, tables.swept))
    assert again == kept.rows and list(again) == [0, 20]
    assert again[20][0] == {
        "eval/return_mean": 3.0,
        "eval/return_std": 1.0,
        "eval/episode_length_mean": 100.0,
        "eval/value_bias": -1.5,
        "train/q_std": 0.1,
        "train/temperature": 0.1,
    }


def test_a_new_run_has_none(tmp_path):
    with records.Records(tmp_path, make_members([3], [make_config("td3", "ant")]), [], tensorboard=False):
        assert list(past_rows(tmp_path, [])) == []
