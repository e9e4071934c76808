"""The critics' loss and its gradient by hand. The update: test_agents."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sqt_jax.agents import critic

pytestmark = pytest.mark.usefixtures("strict_dtypes")

Q = jnp.array([[1.0, 2.0], [3.0, 5.0]])


def test_squared_error_sums_over_critics_and_averages_over_the_batch(maybe_jit):
    loss = maybe_jit(critic.squared_error)(Q, jnp.array([0.0, 2.0]))
    assert loss.shape == ()
    np.testing.assert_allclose(loss, (1 + 0) / 2 + (9 + 9) / 2)


def test_squared_error_of_one_more_critic_leaves_the_others_gradients():
    grad = jax.grad(critic.squared_error)(Q, jnp.array([0.0, 2.0]))
    np.testing.assert_allclose(grad, [[1, 0], [3, 3]])  # 2 (q - y) / B
    np.testing.assert_allclose(jax.grad(critic.squared_error)(Q[:1], jnp.array([0.0, 2.0])), grad[:1])
