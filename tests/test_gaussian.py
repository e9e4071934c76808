"""The squashed Gaussian: parameters, log-probabilities by hand, no underflow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from sqt_jax import gaussian

pytestmark = pytest.mark.usefixtures("strict_dtypes")

# All different, so that no axis can be taken for another.
O, A, B, N, HIDDEN = 3, 2, 4, 5, (7, 6)
KEY = jax.random.key(0)
OBS = jax.random.normal(jax.random.key(1), (B, O))


def shapes(params):
    return jax.tree.map(lambda leaf: leaf.shape, params)


def layer(*shape):
    return {"kernel": shape, "bias": (*shape[:-2], shape[-1])}


def constant_params(net, value):
    return jax.tree.map(lambda leaf: jnp.full(leaf.shape, value), jax.eval_shape(net.init, KEY, OBS))


def test_gaussian_actor_has_these_parameters():
    params = jax.eval_shape(gaussian.GaussianActor(A, HIDDEN).init, KEY, OBS)
    expected = {"layer0": layer(O, 7), "layer1": layer(7, 6), "mean": layer(6, A), "log_std": layer(6, A)}
    assert shapes(params) == {"params": expected}


def test_log_std_is_clamped():
    net = gaussian.GaussianActor(A, HIDDEN)
    params = constant_params(net, 0.0)
    params["params"]["log_std"]["bias"] = jnp.array([1e4, -1e4])
    np.testing.assert_array_equal(net.apply(params, OBS).log_std, np.broadcast_to([2.0, -20.0], (B, A)))
    params["params"]["log_std"]["bias"] = jnp.array([1.5, -19.5])
    np.testing.assert_array_equal(net.apply(params, OBS).log_std, np.broadcast_to([1.5, -19.5], (B, A)))


# The squashed Gaussian

MEAN = jnp.array([[0.0, 0.5], [-1.0, 1.5], [0.3, -0.2], [2.0, 0.0]])
LOG_STD = jnp.array([[0.0, -1.0], [0.5, -0.5], [-3.0, 0.2], [-1.0, -2.0]])
EPS = jax.random.normal(KEY, (B, A))


def test_log_prob_is_the_change_of_variables(maybe_jit):
    action, log_prob = maybe_jit(lambda eps: gaussian.Gaussian(MEAN, LOG_STD).sample(eps))(EPS)
    mean, std = np.asarray(MEAN, np.float64), np.exp(np.asarray(LOG_STD, np.float64))
    u = mean + std * np.asarray(EPS, np.float64)
    np.testing.assert_allclose(action, np.tanh(u), rtol=1e-5, atol=1e-6)
    expected = (stats.norm.logpdf(u, mean, std) - np.log1p(-(np.tanh(u) ** 2))).sum(axis=-1)
    assert log_prob.shape == (B,)
    np.testing.assert_allclose(log_prob, expected, rtol=1e-5, atol=1e-5)


def test_the_density_of_actions_integrates_to_one():
    mean, log_std = 0.5, -0.5

    @jax.jit
    def density(action):
        eps = (jnp.arctanh(action) - mean) / jnp.exp(log_std)
        return jnp.exp(gaussian.Gaussian(jnp.full(1, mean), jnp.full(1, log_std)).sample(eps[None])[1])

    action = np.linspace(-0.9999, 0.9999, 20001, dtype=np.float32)
    total = integrate.trapezoid(jax.vmap(density)(action), action)
    np.testing.assert_allclose(total, 1, atol=2e-3)


@pytest.mark.parametrize("u", [-1000.0, -50.0, -10.0, 10.0, 50.0, 1000.0])
def test_log_prob_does_not_underflow(maybe_jit, u):
    policy = gaussian.Gaussian(jnp.full((1, 1), u), jnp.zeros((1, 1)))
    action, log_prob = maybe_jit(lambda eps: policy.sample(eps))(jnp.zeros((1, 1)))
    assert abs(float(action[0, 0])) == pytest.approx(1)
    # far out, log(1 - tanh(u)^2) is 2 log 2 - 2 |u|
    np.testing.assert_allclose(log_prob, [-0.5 * np.log(2 * np.pi) - 2 * np.log(2) + 2 * abs(u)], rtol=1e-5)
    grad = jax.grad(lambda mean: gaussian.Gaussian(mean, policy.log_std).sample(jnp.zeros((1, 1)))[1][0])(policy.mean)
    np.testing.assert_allclose(grad, [[2 * np.sign(u)]], rtol=1e-5)


def test_mode_is_the_squashed_mean():
    np.testing.assert_allclose(gaussian.Gaussian(MEAN, LOG_STD).mode(), np.tanh(MEAN), rtol=1e-6)
    action, _ = gaussian.Gaussian(MEAN, LOG_STD).sample(jnp.zeros((B, A)))
    np.testing.assert_allclose(action, np.tanh(MEAN), rtol=1e-6)
