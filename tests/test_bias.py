"""The bias of critics, on episodes whose returns are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from probe_envs import constant_reward, countdown

from sqt_jax import bias
from sqt_jax.bias import BiasSums
from sqt_jax.evaluate import evaluate_with_bias

KEY = jax.random.key(0)


def measure(env, q, gamma, *, bonus=0.0, episodes=2):
    """The biases of critics whose values are `q(obs) [N, E]`, along episodes of a policy that does nothing."""

    def policy(obs, key):
        return jnp.zeros((len(obs), env.action_size)), jnp.full(len(obs), bonus)

    def run(gamma):
        return evaluate_with_bias(
            env, policy, lambda obs, action: q(obs), gamma, KEY, episodes, num_bias_episodes=episodes
        )

    evaluation, found = jax.jit(run)(jnp.float32(gamma))
    assert tuple(found) == bias.NAMES
    return evaluation, [float(value) for value in found.values()]


def truth_of_countdown(obs):
    """1 + gamma + ... over the steps left, gamma = 0.5: 1.75, 1.5 and 1."""
    return jnp.array([1.75, 1.5, 1.0])[obs[:, 0].astype(int)]


def test_exact_critics_have_no_bias():
    evaluation, found = measure(countdown(3), lambda obs: jnp.stack([truth_of_countdown(obs)] * 2), 0.5)
    np.testing.assert_allclose(found, 0, atol=1e-6)
    np.testing.assert_array_equal(evaluation.returns, [3, 3])


def test_the_mean_and_the_minimum_of_the_critics_have_a_bias_each():
    def q(obs):
        return jnp.stack([truth_of_countdown(obs) + 3, truth_of_countdown(obs) - 1])

    _, found = measure(countdown(3), q, 0.5)
    mean_return = (1.75 + 1.5 + 1) / 3
    np.testing.assert_allclose(found, [1.0, -1.0, 1.0 / mean_return], rtol=1e-5)


@pytest.mark.parametrize(("scale", "normalised"), [(2.0, 5 / 2), (0.0, np.nan), (1.2e-38, np.nan)])
def test_the_normalised_bias_is_not_measured_where_the_mean_return_is_0(scale, normalised):
    """One state with Q = return + 5, of an episode whose only reward is `-scale`; 5 / 1.2e-38 is beyond float32."""
    sums = BiasSums.start(1).add(
        jnp.array([True]), 9, jnp.float32([-scale]), jnp.zeros(1), jnp.float32([[5 - scale]]), jnp.float32(0.5)
    )
    found = sums.result(jnp.array([True]))
    np.testing.assert_allclose(found["value_bias"], 5, rtol=1e-6)
    np.testing.assert_allclose(found["value_bias_normalised"], normalised, rtol=1e-6)


def test_bonuses_count_from_the_next_action_on():
    # With a bonus of 2 per action, Q of the last state is its reward only, of the one before 1 + 0.5 (2 + 1), ...
    truth = jnp.array([1 + 0.5 * (2 + 1 + 0.5 * (2 + 1)), 1 + 0.5 * (2 + 1), 1.0])
    _, found = measure(countdown(3), lambda obs: truth[obs[:, 0].astype(int)][None], 0.5, bonus=2.0)
    np.testing.assert_allclose(found, 0, atol=1e-6)


def test_the_last_states_of_a_truncated_episode_do_not_count():
    # Q = 1 / (1 - gamma) everywhere; of 40 steps those count after which 0.5^steps is at most 1 %: the first 34.
    _, found = measure(constant_reward(40), lambda obs: jnp.full((1, len(obs)), 2.0), 0.5)
    exact = np.mean([2 - (2 - 2 * 0.5 ** (40 - step)) for step in range(34)])
    np.testing.assert_allclose(found[0], exact, rtol=1e-3)
    assert 0 < found[0] < 0.02


def test_episodes_shorter_than_the_tail_have_no_bias():
    _, found = measure(constant_reward(5), lambda obs: jnp.zeros((1, len(obs))), 0.99)
    assert np.isnan(found).all()


@given(
    rewards=st.lists(st.floats(-10, 10, width=32), min_size=1, max_size=30),
    gamma=st.floats(0.125, 1.0, width=32),
    limit=st.integers(30, 60),
    terminated=st.booleans(),
)
def test_the_running_sums_are_the_mean_over_the_returns(rewards, gamma, limit, terminated):
    count = len(rewards)
    sums, none, factor = BiasSums.start(1), jnp.zeros(1), jnp.float32(gamma)
    for step, reward in enumerate(rewards):
        q = jnp.full((1, 1), float(step))
        sums = sums.add(jnp.array([True]), limit - step, jnp.float32([reward]), none, q, factor)
    # Steps after the end change nothing.
    sums = sums.add(jnp.array([False]), 0, none + 1e3, none + 1, jnp.ones((1, 1)), factor)
    returns = [sum(gamma**k * r for k, r in enumerate(rewards[start:])) for start in range(count)]
    states = [s for s in range(count) if terminated or np.float32(gamma) ** np.float32(limit - s) <= bias.TAIL]
    found = float(sums.result(jnp.array([terminated]))["value_bias"])
    if not states:
        assert np.isnan(found)
    else:
        expected = np.mean([s - returns[s] for s in states])
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-3)
