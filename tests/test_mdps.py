"""The MDPs are MDPs, and their optimal values are right: by hand, by Bellman's equation, by linear equations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.theorem import mdps


def two_states():
    """In state 0: stay for 1, or go to state 1 for 0. In state 1: end for 4, or go back for 0."""
    transition = np.zeros((2, 2, 2))
    transition[0, 0, 0] = transition[0, 1, 1] = transition[1, 1, 0] = 1.0
    return mdps.Mdp(transition, np.array([[1.0, 0.0], [4.0, 0.0]]), np.zeros((2, 2)), np.array([1.0, 0.0]))


def test_optimal_values_by_hand():
    # gamma 1/2: V(1) = 4; V(0) = max(1 + V(0) / 2, 4 / 2) = 2 either way; going back gives 1.
    np.testing.assert_allclose(mdps.optimal_q(two_states(), 0.5), [[2.0, 2.0], [4.0, 1.0]], atol=1e-11)
    # gamma 0.9: always staying gives 10; going back from 1 gives 9, which beats 4.
    np.testing.assert_allclose(mdps.optimal_q(two_states(), 0.9), [[10.0, 8.1], [4.0, 9.0]], atol=1e-10)
    np.testing.assert_array_equal(mdps.optimal_q(two_states(), 0.0), two_states().reward)


@given(st.integers(0, 10_000), st.integers(1, 8), st.integers(1, 4), st.sampled_from([0.0, 0.5, 0.9, 0.99]))
def test_optimal_values_solve_bellmans_equation_and_are_a_policys(seed, states, actions, gamma):
    mdp = mdps.random_mdp(seed, states, actions)
    q = mdps.optimal_q(mdp, gamma)
    np.testing.assert_allclose(q, mdps.backup(mdp, q.max(axis=1), gamma), atol=1e-10)
    greedy = mdps.policy_q(mdp, q.argmax(axis=1), gamma)
    np.testing.assert_allclose(q, greedy, atol=1e-9)
    other = mdps.policy_q(mdp, q.argmin(axis=1), gamma)
    assert (other <= q + 1e-9).all()


@pytest.mark.parametrize("name", mdps.MDPS)
def test_probabilities(name):
    mdp = mdps.MDPS[name](3)
    assert (mdp.transition >= 0).all() and (mdp.transition.sum(axis=-1) <= 1 + 1e-12).all()
    assert mdp.start.sum() == pytest.approx(1)
    assert name in mdps.ABOUT and name in mdps.TITLES
    # every state is reached by random actions
    reached = mdp.start > 0
    for _ in range(len(reached)):
        reached = reached | (reached @ mdp.transition.sum(axis=1) > 0)
    assert reached.all()


def test_leaving_the_chain_at_once_is_optimal():
    q = mdps.optimal_q(mdps.bias_chain(links=3, actions=4, mean=-0.1), 0.5)
    after = -0.1 * (1 + 0.5 + 0.25)
    np.testing.assert_allclose(q[0], [0, 0, 0.5 * after, 0.5 * after])
    np.testing.assert_allclose(q[1:, 0], [after, -0.15, -0.1])


def test_the_grid_without_slipping():
    q = mdps.optimal_q(mdps.grid_world(size=2, slip=0.0, step=-0.1), 0.5)
    # moves: up, down, left, right; states: 0 1 / 2 goal. The goal is down from 1, and right from 2.
    np.testing.assert_allclose(q[1], [-0.1 + 0.5, 1.0, -0.1 + 0.5 * 0.4, -0.1 + 0.5])
    np.testing.assert_allclose(q[0].max(), -0.1 + 0.5 * 1.0)


def test_slipping_goes_in_any_direction():
    mdp = mdps.grid_world(size=3, slip=0.4)
    np.testing.assert_allclose(mdp.transition[4, 0], [0, 0.7, 0, 0.1, 0, 0.1, 0, 0.1], atol=1e-12)
    np.testing.assert_allclose(mdp.transition[7, 3].sum(), 1 - 0.7)  # the goal is to the right of it
    np.testing.assert_allclose(mdp.reward[7, 3], 0.7 * 1 + 0.3 * -0.1)


def test_centred_values_are_0_on_average_if_no_episode_ends():
    mdp = mdps.centred(mdps.random_mdp(5), 0.8)
    assert mdps.optimal_q(mdp, 0.8).mean() == pytest.approx(0, abs=1e-10)
    chain = mdps.bias_chain()
    assert mdps.centred(chain, 0.8) is chain


def test_a_discount_of_one_is_rejected():
    with pytest.raises(ValueError, match="gamma"):
        mdps.optimal_q(two_states(), 1.0)
