"""The released code's agents: Gaussian actors for TD3's rules, averaged log-probabilities, SALE without training."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sqt_jax import sale
from sqt_jax.agents import released
from sqt_jax.algorithms import default_agent_config, make_parts
from sqt_jax.gaussian import Gaussian
from sqt_jax.types import Transition

O, A, B, Z = 3, 2, 16, 8
KEY = jax.random.key(0)
SALE = {"networks": "sale", "hidden": (8, 8), "embedding_size": Z}
quick_jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def make_batch(seed) -> Transition:
    generator = np.random.default_rng(seed)
    obs, next_obs = generator.normal(size=(2, B, O))
    action, discount = generator.uniform(-1, 1, size=(B, A)), generator.random(B) < 0.8
    fields = (obs, action, generator.normal(size=B), next_obs, discount)
    return Transition(*(jnp.asarray(field, jnp.float32) for field in fields))


def make(algo, **changes):
    config = dataclasses.replace(default_agent_config(algo), **SALE | changes)
    return config, make_parts(algo, config, O, A)


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_every_setting_of_this_module_chooses_it():
    for setting in released.SETTINGS:
        assert hasattr(default_agent_config("td3"), setting)
    assert "released" in make("td3", sampled_actor=True)[1].draw.__module__
    assert "released" not in make_parts("td7", default_agent_config("td7"), O, A).draw.func.__module__


def test_a_sampled_actor_acts_by_its_mode_and_learns_from_its_samples():
    config, parts = make("td3", sampled_actor=True)
    state, batch = quick_jit(parts.agent.init)(KEY), make_batch(0)
    zs = sale.encoder(Z, config.hidden).zs(state.fixed_encoder, batch.obs)
    mode = sale.sale_actor(A, config.hidden, gaussian=True).apply(state.actor, batch.obs, zs).mode()
    act = quick_jit(parts.agent.act, static_argnames="deterministic")
    np.testing.assert_allclose(act(state, batch.obs, KEY, deterministic=True), mode, rtol=1e-5, atol=1e-6)
    explored = act(state, batch.obs, KEY) - mode
    assert 0 < np.abs(explored).max() < 6 * config.exploration_noise
    draws = parts.draw(KEY, batch)
    assert draws.action_eps.shape == (B, A)
    update = quick_jit(parts.update)  # step 1 is the actor's turn
    one, other = (update(state, batch, draws._replace(action_eps=draws.action_eps * c), 1)[0] for c in (1, -1))
    assert same(one.critic, other.critic) and not same(one.actor, other.actor)


def test_log_probabilities_before_tanh_are_averaged(maybe_jit):
    config, _ = make("sac", squashed_log_prob=False)
    gaussian = Gaussian(jnp.zeros((1, 2)), jnp.log(jnp.array([[1.0, 2.0]])))
    eps = jnp.array([[0.0, 1.0]])
    action, log_prob = maybe_jit(lambda: released.sample(gaussian, eps, config))()
    np.testing.assert_allclose(action, np.tanh([[0.0, 2.0]]), rtol=1e-6)
    by_hand = np.mean([-0.5 * np.log(2 * np.pi), -0.5 - np.log(2) - 0.5 * np.log(2 * np.pi)])
    np.testing.assert_allclose(log_prob, [by_hand], rtol=1e-6)
    squashed = released.sample(gaussian, eps, dataclasses.replace(config, squashed_log_prob=True))
    assert same(squashed, gaussian.sample(eps))


@pytest.mark.parametrize("algo", ["td3", pytest.param("sac", marks=pytest.mark.slow)])
def test_an_untrained_encoder_stays_and_unbounded_values_are_not_clipped(algo):
    _, parts = make(algo, train_encoder=False, value_clipping=False)
    first = state = quick_jit(parts.agent.init)(KEY)
    update = quick_jit(parts.update)
    for k in range(3):
        batch = make_batch(k)
        state, td_error, metrics = update(state, batch, parts.draw(jax.random.key(k), batch), k)
    assert np.isfinite(metrics["critic_loss"]) and "encoder_loss" not in metrics
    assert same(first.encoder, state.encoder) and same(first.value_bounds, state.value_bounds)
    assert not same(first.critic, state.critic) and not same(first.actor, state.actor)
    assert not parts.agent.views.status(state)  # bounds that do nothing are not reported


def test_sacs_critics_estimate_the_stochastic_policy():
    config, parts = make("sac")
    state, obs = quick_jit(parts.agent.init)(KEY), make_batch(0).obs
    action, bonus = quick_jit(parts.agent.views.sample)(state, obs, KEY)
    zs = sale.encoder(Z, config.hidden).zs(state.fixed_encoder, obs)
    gaussian = sale.sale_actor(A, config.hidden, gaussian=True).apply(state.actor, obs, zs)
    expected, log_prob = gaussian.sample(jax.random.normal(KEY, (B, A)))
    np.testing.assert_allclose(action, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(bonus, -config.temperature * log_prob, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algo", "baseline", "n"),
    [("td3_sqt", "td3", 3), ("redq_sqt", "redq", 10), ("sac_sqt_tuple", "sac", 2), ("maxmin_sqt", "maxmin", 4)],
)
def test_updates_are_finite_and_coefficient_0_is_the_baseline(algo, baseline, n):
    first = quick_jit(make(algo, ensemble_size=n)[1].agent.init)(KEY)

    def after(update, coef):
        state = first._replace(scalars=first.scalars._replace(penalty_coef=jnp.float32(coef)))
        for k in range(3):
            state, td_error, metrics = update(state, make_batch(k), jax.random.key(k), k)
            assert td_error.shape == (B,) and np.isfinite(metrics["critic_loss"])
        return state._replace(scalars=None)

    plain, ours = (quick_jit(make(name, ensemble_size=n)[1].agent.update) for name in (baseline, algo))
    zero, half = after(ours, 0), after(ours, 0.5)
    assert same(after(plain, 0), zero) and not same(zero, half)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(half))
    assert all(leaf.shape[0] == n for leaf in jax.tree.leaves(half.critic))
