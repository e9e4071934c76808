"""Names, shapes and initial values of the parameters; ensembles as separate critics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

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
    params = jax.eval_shape(networks.ensemble(networks.Critic, n, HIDDEN).init, KEY, OBS, ACTION)
    expected = {"layer0": layer(n, O + A, 7), "layer1": layer(n, 7, 6), "layer2": layer(n, 6, 1)}
    assert shapes(params) == {"params": expected}


def test_a_normalised_layer_by_hand():
    """Hidden values 1 and 3: mean 2, std 1, so -1 and 1; times the scale, plus the shift, then ReLU."""
    critic = networks.Critic((2,), layer_norm=True)
    params = {
        "layer0": {"kernel": jnp.array([[1.0, 3.0], [0.0, 0.0]]), "bias": jnp.zeros(2)},
        "norm0": {"scale": jnp.array([2.0, 3.0]), "bias": jnp.array([2.5, 0.5])},
        "layer1": {"kernel": jnp.array([[10.0], [1.0]]), "bias": jnp.array([0.25])},
    }
    obs, action = jnp.ones((1, 1)), jnp.ones((1, 1))
    found = critic.apply({"params": params}, obs, action)
    np.testing.assert_allclose(found, [10 * 0.5 + 3.5 + 0.25], rtol=1e-5)
    # The size of an observation does not matter to the first layer.
    np.testing.assert_allclose(critic.apply({"params": params}, 1000 * obs, action), found, rtol=1e-5)


def test_normalised_critics_are_separate_and_start_as_the_others():
    plain = networks.ensemble(networks.Critic, N, HIDDEN).init(KEY, OBS, ACTION)["params"]
    normalised = networks.ensemble(networks.Critic, N, HIDDEN, True).init(KEY, OBS, ACTION)["params"]
    assert shapes(normalised["norm1"]) == {"scale": (N, 6), "bias": (N, 6)}
    assert all(np.array_equal(plain[name]["kernel"], normalised[name]["kernel"]) for name in plain)


@pytest.fixture(scope="module")
def ensemble():
    net = networks.ensemble(networks.Critic, N, HIDDEN)
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
