"""SAC's loss of the temperature by hand. The rest of SAC: test_agents."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sqt_jax.agents import sac

pytestmark = pytest.mark.usefixtures("strict_dtypes")


def test_temperature_loss_is_the_dual(maybe_jit):
    loss = maybe_jit(sac.temperature_loss)(jnp.log(0.5), jnp.array([1.0, 3.0]), -4.0)
    assert loss.shape == ()
    np.testing.assert_allclose(loss, -0.5 * (2 - 4), rtol=1e-6)


@pytest.mark.parametrize(("entropy", "rises"), [(-5.0, True), (-3.0, False)])
def test_temperature_rises_where_the_entropy_is_below_its_target(entropy, rises):
    log_prob = jnp.full(8, -entropy)
    grad = jax.grad(sac.temperature_loss)(jnp.log(0.2), log_prob, -4.0)
    np.testing.assert_allclose(grad, 0.2 * (entropy + 4), rtol=1e-5)
    assert (-grad > 0) == rises  # a step is against the gradient
