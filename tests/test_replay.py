"""Uniform sampling over the transitions in a ring; the ring itself: test_ring.py."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from test_ring import Stream

from sqt_jax import replay
from sqt_jax.ring import Ring

pytestmark = pytest.mark.usefixtures("strict_dtypes")

O, A, BATCH = 3, 2, 32
CAPACITY = 6


@cache
def compiled(capacity=CAPACITY, batch=BATCH, min_mean_episode_length=1):
    buffer = replay.uniform(Ring(capacity, O, A, min_mean_episode_length=min_mean_episode_length), batch)
    return buffer.init, jax.jit(buffer.insert), jax.jit(buffer.sample)


def filled(init, insert, ends):
    """A buffer after steps of one environment, whose episodes end at `ends`; and the inserted transitions."""
    state, stream = init(), Stream(1)
    for over in ends:
        state = insert(state, stream.step([over]))
    return state, stream


@pytest.mark.parametrize("rows", [1, 5, 8, 21], ids=["one row", "partly", "full", "round"])
def test_sampling_is_uniform_over_the_newest_transitions(rows):
    init, insert, sample = compiled(capacity=8, batch=8000)
    state, stream = filled(init, insert, [False] * rows)
    rewards, counts = np.unique(sample(state, jax.random.key(0))[0].reward, return_counts=True)
    np.testing.assert_array_equal(rewards, [float(t.reward) for t in stream.transitions[-8:]])
    assert rows == 1 or stats.chisquare(counts).pvalue > 1e-3


def test_a_transition_that_lost_its_final_observation_is_not_sampled_nor_are_older_ones():
    init, insert, sample = compiled(
        capacity=8, batch=8000, min_mean_episode_length=8
    )  # room for two final observations
    state, stream = filled(init, insert, [True, False, True, True, False, False, True, False])
    # Number 0's went for number 3's, number 2's for number 6's.
    rewards, counts = np.unique(sample(state, jax.random.key(0))[0].reward, return_counts=True)
    np.testing.assert_array_equal(rewards, [float(t.reward) for t in stream.transitions[3:]])
    assert stats.chisquare(counts).pvalue > 1e-3


def test_a_batch_is_the_transitions_of_the_rows_that_it_names():
    init, insert, sample = compiled()
    state, stream = filled(init, insert, [False, True] * 5)
    batch, rows = sample(state, jax.random.key(0))
    assert rows.shape == (BATCH,) and rows.dtype == jnp.int32
    newest = {number % CAPACITY: transition for number, transition in enumerate(stream.transitions)}
    for i, row in enumerate(np.asarray(rows)):
        for ours, expected in zip(batch, newest[int(row)], strict=True):
            np.testing.assert_array_equal(ours[i], expected)


def test_another_key_samples_another_batch():
    init, insert, sample = compiled()
    state, _ = filled(init, insert, [False] * CAPACITY)
    first, again, other = (sample(state, jax.random.key(seed))[1] for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)


def test_feedback_changes_nothing():
    buffer = replay.uniform(Ring(CAPACITY, O, A), BATCH)
    state, _ = filled(buffer.init, buffer.insert, [False] * CAPACITY)
    after = buffer.feedback(state, jnp.arange(BATCH), jnp.full(BATCH, 1e6), jnp.int32(250))
    assert after is state
