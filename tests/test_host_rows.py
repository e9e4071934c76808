"""Rows of environments on the host: what `test_host.py` does not see through the program."""

import numpy as np
import pytest
from host_tasks import Counter, Mixed, same

from sqt_jax.envs.host_rows import LocalRows, Steps, start_seed


def keys_of(*steps):
    return np.array([[1, 2, step] for step in steps], np.uint32)


def test_a_seed_has_31_bits_and_depends_on_all_words():
    words = np.array([[1, 2, 3], [2, 2, 3], [1, 3, 3], [1, 2, 4]], np.uint32)
    seeds = [start_seed(key) for key in words]
    assert len(set(seeds)) == 4 and all(0 <= seed < 2**31 for seed in seeds)
    assert start_seed(words[0]) == seeds[0]


def test_an_environment_gets_its_starts_seed_at_its_end_only():
    rows = LocalRows(Counter, 2)
    rows.start(keys_of(0, 0))
    rows.step(np.array([[0, 1, 0], [0, 0, 0]], np.float32), keys_of(1, 1))
    assert [env.seed for env in rows.envs] == [start_seed(key) for key in keys_of(1, 0)]


def test_a_packed_row_and_its_parts():
    packed = np.arange(2 * 11.0).reshape(2, 11)
    steps = Steps.of(packed, 3)
    assert Steps.packed_size(3) == 11
    assert steps.obs.tolist() == [[0, 1, 2], [11, 12, 13]] and steps.final_obs.tolist() == [[3, 4, 5], [14, 15, 16]]
    assert [part.tolist() for part in steps[2:]] == [[6, 17], [7, 18], [8, 19], [9, 20], [10, 21]]


def test_actions_are_stretched_to_the_box_and_observations_flattened():
    rows = LocalRows(Mixed, 1)
    rows.start(keys_of(0))
    packed = rows.step(np.array([[1, -0.5]], np.float32), keys_of(1))  # to 1 and 2.5
    steps = Steps.of(packed, 7)
    assert steps.reward.tolist() == [3.5] and sum(steps.obs[0, 4:]) == 1


def test_the_same_environment_twice_is_an_error():
    with pytest.raises(ValueError, match="expects a new environment from each call"):
        LocalRows(same, 2).start(keys_of(0, 0))


def test_close_closes_each_environment():
    class Closing(Counter):
        closed = 0

        def close(self):
            Closing.closed += 1

    rows = LocalRows(Closing, 3)
    rows.start(keys_of(0, 0, 0))
    rows.close()
    rows.close()
    assert Closing.closed == 3


@pytest.mark.parametrize("error", [RuntimeError("in\nuse"), SystemExit(3)])
def test_an_environment_that_cannot_be_closed_is_a_warning_and_the_others_are_closed(error):
    class Stuck(Counter):
        tried = 0

        def close(self):
            Stuck.tried += 1
            raise error

    rows = LocalRows(Stuck, 2)
    rows.start(keys_of(0, 0))
    with pytest.warns(UserWarning, match="an environment could not be closed: (RuntimeError: in use|SystemExit: 3)"):
        rows.close()
    assert Stuck.tried == 2


def test_a_reward_that_is_missing_is_an_error_and_not_nan():
    class Forgetful(Counter):
        def step(self, action):
            obs, _, *rest = super().step(action)
            return obs, None, *rest

    rows = LocalRows(Forgetful, 1)
    rows.start(keys_of(0))
    with pytest.raises(ValueError, match="^reward: expects a number, not None$"):
        rows.step(np.zeros((1, 3), np.float32), keys_of(1))
