"""Names, shapes and starts of the parameters; the squashed Gaussian; ensembles as separate critics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from sqt_jax import networks

pytestmark = pytest.mark.usefixtures("strict_dtypes")

# All different, so that no axis can be taken for another.
O, A, B, N, HIDDEN = 3, 2, 4, 5, (7, 6)
KEY = jax.random.key(0)
OBS = jax.random.normal(jax.random.key(1), (B, O))
ACTION = jax.random.uniform(jax.random.key(2), (B, A), minval=-1.0)


def shapes(params):
    return jax.tree.map(lambda leaf: leaf.shape, params)


def layer(*shape):
    return {"kernel": shape, "bias": (*shape[:-2], shape[-1])}


def constant_params(net, value):
    return jax.tree.map(lambda leaf: jnp.full(leaf.shape, value), jax.eval_shape(net.init, KEY, OBS))


def test_tanh_actor_has_these_parameters():
    params = jax.eval_shape(networks.TanhActor(A, HIDDEN).init, KEY, OBS)
    assert shapes(params) == {"params": {"layer0": layer(O, 7), "layer1": layer(7, 6), "layer2": layer(6, A)}}


def test_gaussian_actor_has_these_parameters():
    params = jax.eval_shape(networks.GaussianActor(A, HIDDEN).init, KEY, OBS)
    expected = {"layer0": layer(O, 7), "layer1": layer(7, 6), "mean": layer(6, A), "log_std": layer(6, A)}
    assert shapes(params) == {"params": expected}


def test_a_layer_of_several_inputs_is_the_layer_of_their_concatenation():
    layer = networks.Dense(7)
    params = layer.init(KEY, OBS, ACTION)
    joined = jnp.concatenate([OBS, ACTION], axis=-1)
    assert shapes(params) == shapes(layer.init(KEY, joined))
    np.testing.assert_allclose(layer.apply(params, OBS, ACTION), layer.apply(params, joined), rtol=1e-6)


def test_an_input_that_needs_no_gradient_costs_none():
    layer = networks.Dense(7)
    params = layer.init(KEY, OBS, ACTION)
    gradient = jax.make_jaxpr(jax.grad(lambda action: layer.apply(params, OBS, action).sum()))(ACTION)
    products = [eqn for eqn in gradient.eqns if eqn.primitive.name == "dot_general"]
    assert [eqn.outvars[0].aval.shape for eqn in products] == [(B, 7), (B, 7), (B, A)]  # two forwards, one back


@pytest.mark.parametrize("n", [1, 2, N])
def test_critics_have_a_leading_axis(n):
    params = jax.eval_shape(networks.critic_ensemble(n, HIDDEN).init, KEY, OBS, ACTION)
    expected = {"layer0": layer(n, O + A, 7), "layer1": layer(n, 7, 6), "layer2": layer(n, 6, 1)}
    assert shapes(params) == {"params": expected}


@pytest.fixture(scope="module")
def ensemble():
    net = networks.critic_ensemble(N, HIDDEN)
    return net, jax.jit(net.init)(KEY, OBS, ACTION)


def test_critics_start_different(ensemble):
    net, params = ensemble
    for leaf in jax.tree.leaves(params):
        assert len(np.unique(np.asarray(leaf).reshape(N, -1), axis=0)) == N
    q = net.apply(params, OBS, ACTION)
    assert q.shape == (N, B)
    assert len(np.unique(np.asarray(q), axis=0)) == N


def test_an_ensemble_is_its_critics_applied_one_by_one(ensemble):
    net, params = ensemble
    q = net.apply(params, OBS, ACTION)
    for i in range(N):
        own = jax.tree.map(lambda leaf, i=i: leaf[i], params)
        np.testing.assert_allclose(q[i], networks.Critic(HIDDEN).apply(own, OBS, ACTION), rtol=1e-5, atol=1e-6)


def test_a_critic_is_affine_relu_affine(ensemble):
    _, params = ensemble
    layers = jax.tree.map(lambda leaf: np.asarray(leaf[0], np.float64), params["params"])
    x = np.concatenate([OBS, ACTION], axis=-1)
    for name in ("layer0", "layer1"):
        x = np.maximum(x @ layers[name]["kernel"] + layers[name]["bias"], 0)
    expected = (x @ layers["layer2"]["kernel"] + layers["layer2"]["bias"])[:, 0]
    own = jax.tree.map(lambda leaf: leaf[0], params)
    np.testing.assert_allclose(networks.Critic(HIDDEN).apply(own, OBS, ACTION), expected, rtol=1e-5, atol=1e-6)


def test_layers_start_uniform_within_one_over_the_root_of_the_fan_in():
    params = jax.jit(networks.Dense(100).init)(KEY, jnp.ones((1, 64)))["params"]
    for leaf, draws in ((params["kernel"], 6400), (params["bias"], 100)):
        assert leaf.size == draws
        assert stats.kstest(np.asarray(leaf).ravel() * 8, stats.uniform(-1, 2).cdf).pvalue > 1e-3
        assert np.abs(leaf).max() <= 1 / 8


def test_every_layer_starts_within_its_own_bound(ensemble):
    _, params = ensemble
    for leaves in params["params"].values():
        bound = leaves["kernel"].shape[-2] ** -0.5
        assert 0.5 * bound < np.abs(leaves["kernel"]).max() <= bound
        assert np.abs(leaves["bias"]).max() <= bound


def test_tanh_actor_stays_within_the_actions():
    net = networks.TanhActor(A, HIDDEN)
    params = constant_params(net, 0.0)
    params["params"]["layer2"]["bias"] = jnp.array([1e6, -1e6])
    np.testing.assert_array_equal(net.apply(params, OBS), np.broadcast_to([1.0, -1.0], (B, A)))
    np.testing.assert_array_equal(net.apply(constant_params(net, 0.0), OBS), np.zeros((B, A)))


def test_log_std_is_clamped():
    net = networks.GaussianActor(A, HIDDEN)
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
    action, log_prob = maybe_jit(lambda eps: networks.Gaussian(MEAN, LOG_STD).sample(eps))(EPS)
    mean, std = np.asarray(MEAN, np.float64), np.exp(np.asarray(LOG_STD, np.float64))
    u = mean + std * np.asarray(EPS, np.float64)
    np.testing.assert_allclose(action, np.tanh(u), rtol=1e-5, atol=1e-6)
    expected = (stats.norm.logpdf(u, mean, std) - np.log1p(-(np.tanh(u) ** 2))).sum(axis=-1)
    assert log_prob.shape == (B,)
    np.testing.assert_allclose(log_prob, expected, rtol=1e-5, atol=1e-5)


def test_unsquashed_log_prob_is_the_gaussians_own_averaged_over_dims(maybe_jit):
    gaussian = networks.Gaussian(MEAN, LOG_STD)
    action, log_prob = maybe_jit(lambda eps: gaussian.sample(eps, squashed_log_prob=False))(EPS)
    np.testing.assert_array_equal(action, maybe_jit(lambda eps: gaussian.sample(eps)[0])(EPS))
    mean, std = np.asarray(MEAN, np.float64), np.exp(np.asarray(LOG_STD, np.float64))
    expected = stats.norm.logpdf(mean + std * np.asarray(EPS, np.float64), mean, std).mean(axis=-1)
    np.testing.assert_allclose(log_prob, expected, rtol=1e-5, atol=1e-5)


def test_the_density_of_actions_integrates_to_one():
    mean, log_std = 0.5, -0.5

    @jax.jit
    def density(action):
        eps = (jnp.arctanh(action) - mean) / jnp.exp(log_std)
        return jnp.exp(networks.Gaussian(jnp.full(1, mean), jnp.full(1, log_std)).sample(eps[None])[1])

    action = np.linspace(-0.9999, 0.9999, 20001, dtype=np.float32)
    total = integrate.trapezoid(jax.vmap(density)(action), action)
    np.testing.assert_allclose(total, 1, atol=2e-3)


@pytest.mark.parametrize("u", [-1000.0, -50.0, -10.0, 10.0, 50.0, 1000.0])
def test_log_prob_does_not_underflow(maybe_jit, u):
    policy = networks.Gaussian(jnp.full((1, 1), u), jnp.zeros((1, 1)))
    action, log_prob = maybe_jit(lambda eps: policy.sample(eps))(jnp.zeros((1, 1)))
    assert abs(float(action[0, 0])) == pytest.approx(1)
    # far out, log(1 - tanh(u)^2) is 2 log 2 - 2 |u|
    np.testing.assert_allclose(log_prob, [-0.5 * np.log(2 * np.pi) - 2 * np.log(2) + 2 * abs(u)], rtol=1e-5)
    grad = jax.grad(lambda mean: networks.Gaussian(mean, policy.log_std).sample(jnp.zeros((1, 1)))[1][0])(policy.mean)
    np.testing.assert_allclose(grad, [[2 * np.sign(u)]], rtol=1e-5)


def test_mode_is_the_squashed_mean():
    np.testing.assert_allclose(networks.Gaussian(MEAN, LOG_STD).mode(), np.tanh(MEAN), rtol=1e-6)
    action, _ = networks.Gaussian(MEAN, LOG_STD).sample(jnp.zeros((B, A)))
    np.testing.assert_allclose(action, np.tanh(MEAN), rtol=1e-6)
