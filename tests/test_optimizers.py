"""Adam against optax's own, the soft step of target networks, and that neither changes a diverged agent."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from sqt_jax.optimizers import adam_init, adam_step, soft_update

PARAMS = {"kernel": jnp.array([[1.0, -2.0]]), "bias": jnp.array([0.5, 0.0])}


def loss(params):
    return jnp.sum(params["kernel"] ** 2) + jnp.sum(jnp.sin(params["bias"]))


def run(lr, steps, step=adam_step):
    params, opt_state = PARAMS, adam_init(PARAMS)
    for _ in range(steps):
        params, opt_state, _ = step(params, opt_state, jax.grad(loss)(params), lr, jnp.array(False))
    return params, opt_state


def assert_same(a, b, **tolerance):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, **tolerance), a, b)


@pytest.mark.parametrize("lr", [3e-4, 0.1])
def test_adam_is_optax_adam(lr):
    reference = optax.adam(lr)
    params, opt_state = PARAMS, reference.init(PARAMS)
    for _ in range(5):
        updates, opt_state = reference.update(jax.grad(loss)(params), opt_state)
        params = optax.apply_updates(params, updates)
    assert_same(run(lr, 5)[0], params, rtol=1e-6)


def test_the_first_step_has_the_learning_rates_length():
    first = run(0.01, 1)[0]
    np.testing.assert_allclose(first["kernel"], [[0.99, -1.99]], rtol=1e-5)
    np.testing.assert_allclose(first["bias"], [0.49, -0.01], rtol=1e-5)


def test_learning_rates_share_one_compilation():
    step = jax.jit(adam_step)
    slow, fast = run(jnp.float32(1e-3), 1, step)[0], run(jnp.float32(1e-2), 1, step)[0]
    assert step._cache_size() == 1
    change = jax.tree.map(lambda s, f, p: (f - p) / (s - p), slow, fast, PARAMS)
    assert_same(change, jax.tree.map(lambda p: jnp.full(p.shape, 10.0), PARAMS), rtol=1e-2)


def test_learning_rate_zero_changes_only_the_moments():
    params, opt_state = run(0.0, 2)
    assert_same(params, PARAMS)
    assert opt_state.count == 2
    assert np.all(opt_state.mu["kernel"] != 0)


@pytest.mark.parametrize(("tau", "expected"), [(0.0, [1, 2]), (1.0, [5, -2]), (0.25, [2, 1])])
def test_soft_update(maybe_jit, tau, expected):
    target, online = {"w": jnp.array([1.0, 2.0])}, {"w": jnp.array([5.0, -2.0])}
    np.testing.assert_allclose(maybe_jit(soft_update)(target, online, tau, jnp.array(False))["w"], expected, rtol=1e-6)


def test_nothing_moves_where_an_agent_has_diverged(maybe_jit):
    params, opt_state = run(0.1, 2)
    grads = jax.tree.map(lambda p: jnp.full(p.shape, jnp.nan), PARAMS)
    after = maybe_jit(adam_step)(params, opt_state, grads, 0.1, jnp.array(True))
    jax.tree.map(np.testing.assert_array_equal, after[:2], (params, opt_state))
    assert after[2]
    kept = maybe_jit(soft_update)(params, grads, 0.5, jnp.array(True))
    jax.tree.map(np.testing.assert_array_equal, kept, params)


@pytest.mark.parametrize(
    ("value", "expected"),
    [(0.0, False), (1e15, False), (1e25, True), (jnp.inf, True), (-jnp.inf, True), (jnp.nan, True)],
)
def test_an_agent_diverges_where_adam_could_not_square_a_gradient(maybe_jit, value, expected):
    grads = {"kernel": jnp.ones((1, 2)), "bias": jnp.array([1.0, value])}
    params, opt_state, diverged = maybe_jit(adam_step)(PARAMS, adam_init(PARAMS), grads, 0.1, jnp.array(False))
    assert diverged == expected
    assert (opt_state.count == 0) == expected and np.array_equal(params["kernel"], PARAMS["kernel"]) == expected
