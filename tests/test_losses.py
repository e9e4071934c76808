"""Hand-worked losses, with and without jit, and what their gradients push towards."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sqt_jax import losses

pytestmark = pytest.mark.usefixtures("strict_dtypes")

Q = jnp.array([[1.0, 2.0], [3.0, 5.0]])


def test_critic_loss_sums_over_critics_and_averages_over_the_batch(maybe_jit):
    loss = maybe_jit(losses.critic_loss)(Q, jnp.array([0.0, 2.0]))
    assert loss.shape == ()
    np.testing.assert_allclose(loss, (1 + 0) / 2 + (9 + 9) / 2)


def test_critic_loss_of_one_more_critic_leaves_the_others_gradients():
    grad = jax.grad(losses.critic_loss)(Q, jnp.array([0.0, 2.0]))
    np.testing.assert_allclose(grad, [[1, 0], [3, 3]])  # 2 (q - y) / B
    np.testing.assert_allclose(jax.grad(losses.critic_loss)(Q[:1], jnp.array([0.0, 2.0])), grad[:1])


def test_lap_huber_is_quadratic_below_the_minimum_priority_and_linear_above(maybe_jit):
    target = jnp.array([0.5, 2.0])  # errors 0.5 and 0; 2.5 and 3
    loss = maybe_jit(lambda q, target: losses.lap_huber(q, target, 1.0))(Q, target)
    assert loss.shape == ()
    np.testing.assert_allclose(loss, (0.125 + 0) / 2 + (2.5 + 3) / 2)  # summed over critics, averaged over the batch
    np.testing.assert_allclose(losses.lap_huber(Q, target, 2.75), (0.125 + 0) / 2 + (3.125 + 2.75 * 3) / 2)


def test_lap_hubers_slope_is_bounded():
    grad = jax.grad(lambda q: losses.lap_huber(q, jnp.array([0.5, 2.0]), 1.0))(Q)
    np.testing.assert_allclose(grad, [[0.25, 0], [0.5, 0.5]])  # the error up to 1, per row of the batch
    below = jax.grad(lambda q: losses.lap_huber(q, jnp.array([10.0, -10.0]), 1.0))(Q)
    np.testing.assert_allclose(below, [[-0.5, 0.5], [-0.5, 0.5]])


@pytest.mark.parametrize(("reduce", "expected"), [("mean", [2, 3.5]), ("min", [1, 2]), ("first", [3, 2])])
def test_actor_value(maybe_jit, reduce, expected):
    q = jnp.array([[3.0, 2.0], [1.0, 5.0]])
    np.testing.assert_allclose(maybe_jit(lambda q: losses.actor_value(q, reduce))(q), expected)


def test_temperature_loss_is_the_dual(maybe_jit):
    loss = maybe_jit(losses.temperature_loss)(jnp.log(0.5), jnp.array([1.0, 3.0]), -4.0)
    assert loss.shape == ()
    np.testing.assert_allclose(loss, -0.5 * (2 - 4), rtol=1e-6)


@pytest.mark.parametrize(("entropy", "rises"), [(-5.0, True), (-3.0, False)])
def test_temperature_rises_where_the_entropy_is_below_its_target(entropy, rises):
    log_prob = jnp.full(8, -entropy)
    grad = jax.grad(losses.temperature_loss)(jnp.log(0.2), log_prob, -4.0)
    np.testing.assert_allclose(grad, 0.2 * (entropy + 4), rtol=1e-5)
    assert (-grad > 0) == rises  # a step is against the gradient
