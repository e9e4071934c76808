"""TD7's networks: AvgL1Norm by hand, names and shapes of the parameters, and each network against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sqt_jax import sale
from sqt_jax.agents import td7

pytestmark = pytest.mark.usefixtures("strict_dtypes")

# All different, so that no axis can be taken for another.
O, A, B, N, Z, HIDDEN = 3, 2, 4, 5, 8, (7, 6)
KEY = jax.random.key(0)
OBS = jax.random.normal(jax.random.key(1), (B, O))
ACTION = jax.random.uniform(jax.random.key(2), (B, A), minval=-1.0)
ZS = jax.random.normal(jax.random.key(3), (B, Z))
ZSA = jax.random.normal(jax.random.key(4), (B, Z))

ENCODER, ACTOR = sale.encoder(Z, HIDDEN), sale.sale_actor(A, HIDDEN)


def critics(n):
    return sale.sale_critics(n, HIDDEN)


@pytest.fixture(scope="module")
def params():
    """Of the encoder, the actor and N critics."""
    inits = ((ENCODER.init, OBS, ACTION), (ACTOR.init, OBS, ZS), (critics(N).init, OBS, ACTION, ZSA, ZS))
    return tuple(jax.jit(init)(KEY, *inputs) for init, *inputs in inits)


# AvgL1Norm


def test_avg_l1_norm_divides_by_the_mean_size(maybe_jit):
    x = jnp.array([[1.0, -3.0], [10.0, 0.0], [0.5, 0.5]])  # mean sizes 2, 5 and 0.5
    np.testing.assert_allclose(maybe_jit(sale.avg_l1_norm)(x), [[0.5, -1.5], [2, 0], [1, 1]], rtol=1e-6)


def test_avg_l1_norm_of_anything_has_mean_size_one():
    x = 1e3 * jax.random.normal(KEY, (2, 5, 9))
    np.testing.assert_allclose(jnp.mean(jnp.abs(sale.avg_l1_norm(x)), axis=-1), np.ones((2, 5)), rtol=1e-5)
    np.testing.assert_allclose(sale.avg_l1_norm(0.01 * x), sale.avg_l1_norm(x), rtol=1e-5)


@pytest.mark.parametrize("size", [0.0, 1e-10])
def test_avg_l1_norm_is_finite_at_zero(maybe_jit, size):
    x = jnp.full((1, 4), size)
    np.testing.assert_allclose(maybe_jit(sale.avg_l1_norm)(x), x / 1e-8)
    grad = maybe_jit(jax.grad(lambda x: jnp.sum(sale.avg_l1_norm(x))))(x)
    np.testing.assert_allclose(grad, np.full((1, 4), 1e8), rtol=1e-6)


# Parameters


def layer(*shape):
    return {"kernel": shape, "bias": (*shape[:-2], shape[-1])}


def shapes(params):
    return jax.tree.map(lambda leaf: leaf.shape, params)


def test_the_encoder_has_these_parameters(params):
    expected = {"state0": layer(O, 7), "state1": layer(7, 6), "state2": layer(6, Z)}
    expected |= {"state_action0": layer(Z + A, 7), "state_action1": layer(7, 6), "state_action2": layer(6, Z)}
    assert shapes(params[0]) == {"params": expected}


def test_the_actor_has_these_parameters(params):
    expected = {"layer0": layer(O, 7), "layer1": layer(7 + Z, 7), "layer2": layer(7, 6), "layer3": layer(6, A)}
    assert shapes(params[1]) == {"params": expected}


@pytest.mark.parametrize("n", [1, 2, N])
def test_critics_have_a_leading_axis(n):
    expected = {"layer0": layer(n, O + A, 7), "layer1": layer(n, 7 + 2 * Z, 7)}
    expected |= {"layer2": layer(n, 7, 6), "layer3": layer(n, 6, 1)}
    own = jax.eval_shape(critics(n).init, KEY, OBS, ACTION, ZSA, ZS)
    assert shapes(own) == {"params": expected}
    q = jax.eval_shape(critics(n).apply, own, OBS, ACTION, ZSA, ZS)
    assert q.shape == (n, B) and q.dtype == jnp.float32


def test_layers_start_within_one_over_the_root_of_the_fan_in_and_critics_apart(params):
    for network in params:
        for own in network["params"].values():
            bound = own["kernel"].shape[-2] ** -0.5
            assert 0.5 * bound < np.abs(own["kernel"]).max() <= bound and np.abs(own["bias"]).max() <= bound
    for leaf in jax.tree.leaves(params[2]):
        assert len(np.unique(np.asarray(leaf).reshape(N, -1), axis=0)) == N


# Values


def norm(x):
    return x / np.maximum(np.abs(x).mean(axis=-1, keepdims=True), 1e-8)


def elu(x):
    return np.where(x > 0, x, np.exp(np.minimum(x, 0)) - 1)


def relu(x):
    return np.maximum(x, 0)


def dense(params, name, x):
    own = params["params"][name]
    return x @ np.asarray(own["kernel"], np.float64) + np.asarray(own["bias"], np.float64)


def joined(*parts):
    return np.concatenate([np.asarray(part, np.float64) for part in parts], axis=-1)


def encoder_by_hand(params, obs, action):
    zs = norm(dense(params, "state2", elu(dense(params, "state1", elu(dense(params, "state0", joined(obs)))))))
    x = joined(zs, action)
    for name in ("state_action0", "state_action1"):
        x = elu(dense(params, name, x))
    return zs, dense(params, "state_action2", x)


def test_the_encoder_normalises_zs_and_not_zsa(maybe_jit, params):
    zs = maybe_jit(ENCODER.zs)(params[0], OBS)
    zsa = maybe_jit(ENCODER.zsa)(params[0], zs, ACTION)
    assert zs.shape == zsa.shape == (B, Z)
    expected_zs, expected_zsa = encoder_by_hand(params[0], OBS, ACTION)
    np.testing.assert_allclose(zs, expected_zs, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(zsa, expected_zsa, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(np.abs(zs).mean(axis=-1), np.ones(B), rtol=1e-5)
    assert not np.any(np.isclose(np.abs(zsa).mean(axis=-1), 1, rtol=1e-2))


def test_the_actor_sees_the_normed_observation_and_zs(maybe_jit, params):
    action = maybe_jit(ACTOR.apply)(params[1], OBS, ZS)
    x = joined(norm(dense(params[1], "layer0", joined(OBS))), ZS)
    for name in ("layer1", "layer2"):
        x = relu(dense(params[1], name, x))
    assert action.shape == (B, A)
    np.testing.assert_allclose(action, np.tanh(dense(params[1], "layer3", x)), rtol=1e-4, atol=1e-5)


def test_each_critic_sees_the_normed_input_then_zsa_then_zs(maybe_jit, params):
    q = maybe_jit(critics(N).apply)(params[2], OBS, ACTION, ZSA, ZS)
    assert q.shape == (N, B)
    for i in range(N):
        own = jax.tree.map(lambda leaf, i=i: leaf[i], params[2])
        x = joined(norm(dense(own, "layer0", joined(OBS, ACTION))), ZSA, ZS)
        for name in ("layer1", "layer2"):
            x = elu(dense(own, name, x))
        np.testing.assert_allclose(q[i], dense(own, "layer3", x)[:, 0], rtol=1e-4, atol=1e-5)


def test_the_gaussian_actor_is_the_same_with_a_head_of_log_stds(params):
    net = sale.sale_actor(A, HIDDEN, gaussian=True)
    shape = jax.eval_shape(net.init, KEY, OBS, ZS)["params"]
    assert shapes(shape["log_std"]) == layer(6, A)
    head = {"kernel": jnp.zeros((6, A)), "bias": jnp.array([1.5, 99.0])}
    gaussian = net.apply({"params": params[1]["params"] | {"log_std": head}}, OBS, ZS)
    np.testing.assert_allclose(gaussian.mode(), ACTOR.apply(params[1], OBS, ZS), rtol=1e-6)
    np.testing.assert_array_equal(gaussian.log_std, np.broadcast_to([1.5, 2.0], (B, A)))


def test_actions_stay_within_their_limits(params):
    action = ACTOR.apply(params[1], 1e6 * OBS, 1e6 * ZS)
    assert np.all(np.isfinite(action)) and np.abs(action).max() <= 1


# The encoder's loss


def test_encoder_loss_is_the_mean_square_over_batch_and_embedding(maybe_jit):
    zsa, next_zs = jnp.array([[1.0, 2.0], [0.0, -1.0]]), jnp.array([[0.0, 2.0], [2.0, 1.0]])
    np.testing.assert_allclose(maybe_jit(td7.encoder_loss)(zsa, next_zs), (1 + 0 + 4 + 4) / 4)


def test_encoder_loss_gives_no_gradient_to_the_next_zs(maybe_jit):
    grads = maybe_jit(jax.grad(td7.encoder_loss, argnums=(0, 1)))(ZSA, ZS)
    np.testing.assert_allclose(grads[0], 2 * (ZSA - ZS) / (B * Z), rtol=1e-5)
    np.testing.assert_array_equal(grads[1], np.zeros((B, Z)))
