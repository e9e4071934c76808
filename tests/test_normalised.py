"""Normalised observations: the statistics by hand and against NumPy, and where agents use them."""

import functools

import algorithm_rows
import jax
import jax.numpy as jnp
import numpy as np
import probe_envs
import pytest
import scaled_pendulum
from hypothesis import given
from hypothesis import strategies as st

from experiments.commandline.presets import preset_settings
from sqt_jax import experiment, make_agent
from sqt_jax.agents import normalised
from sqt_jax.agents.normalised import Moments, Statistics, normalise
from sqt_jax.algorithms import BASELINES, make_agent_config, make_parts
from sqt_jax.trees import by_path
from sqt_jax.types import Transition

KEY = jax.random.key(0)
add = jax.jit(normalised.add)


def array(*rows):
    return jnp.array(rows, jnp.float32)


# The statistics


def test_statistics_by_hand(maybe_jit):
    add = maybe_jit(normalised.add)
    with jax.numpy_dtype_promotion("strict"):
        one = add(Statistics.start(1), array([1]))
    assert (one.seen, one.moments.mean, one.moments.variance) == (1, 1, 0)
    two = add(one, array([3]))
    assert (two.seen, two.moments.mean, two.moments.variance) == (2, 2, 1)
    four = add(two, array([5], [7]))  # mean 4; squared deviations 9, 1, 1, 9
    assert (four.seen, four.moments.mean, four.moments.variance) == (4, 4, 5)
    at_once = add(Statistics.start(1), array([7], [1], [5], [3]))
    assert (at_once.seen, at_once.moments.mean, at_once.moments.variance) == (4, 4, 5)
    small = add(Statistics.start(1), array([1e-5], [3e-5]))
    np.testing.assert_allclose((small.moments.mean, small.moments.variance), [[2e-5], [1e-10]], rtol=1e-5)


def test_normalised_observations_by_hand():
    moments = Moments(mean=array(2, -1), variance=array(4, 0.25))
    np.testing.assert_allclose(normalise(moments, array([4, -1], [1, -0.5])), [[1, 0], [-0.5, 1]], rtol=1e-6)
    np.testing.assert_allclose(normalise(moments, array(21.9, -5.9)), [9.95, -9.8], rtol=1e-5)
    np.testing.assert_array_equal(normalise(moments, array(22.1, -6.1)), [10, -10])  # clipped
    np.testing.assert_array_equal(normalise(moments, array(1e10, -1e10)), [10, -10])


def test_before_the_first_observation_they_are_only_clipped():
    obs = array(0.1, -9.5, 11, -1e10)
    np.testing.assert_array_equal(normalise(Statistics.start(4).moments, obs), jnp.clip(obs, -10, 10))


def test_a_constant_dimension_becomes_zero_and_its_first_change_is_clipped():
    statistics = Statistics.start(2)
    for _ in range(5):
        statistics = add(statistics, array([0.1, 1e4], [0.1, 1e4], [0.1, 1e4]))
    np.testing.assert_array_equal(statistics.moments.variance, 0)
    np.testing.assert_array_equal(normalise(statistics.moments, array(0.1, 1e4)), 0)
    np.testing.assert_array_equal(normalise(statistics.moments, array(0.2, 1e4 - 1)), [10, -10])


NUMBERS = st.floats(-1e10, 1e10, width=32, allow_subnormal=False)


@given(data=st.data(), obs=st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=12))
def test_any_split_into_batches_gives_the_moments_of_all(data, obs):
    obs = np.array(obs, np.float32)
    cuts = sorted(data.draw(st.sets(st.integers(1, len(obs) - 1)))) if len(obs) > 1 else []
    statistics = Statistics.start(2)
    for batch in np.split(obs, cuts):
        statistics = add(statistics, jnp.asarray(batch))
    obs = obs.astype(np.float64)
    largest = np.abs(obs).max(axis=0)
    assert statistics.seen == len(obs)
    assert np.all(np.abs(statistics.moments.mean - obs.mean(axis=0)) <= 1e-6 * largest)
    assert np.all(np.abs(statistics.moments.variance - obs.var(axis=0)) <= 1e-6 * largest**2)
    assert np.all(statistics.moments.variance >= 0)


@pytest.mark.parametrize("num_envs", [1, 3])
def test_many_observations_keep_their_digits(num_envs):
    n = 300_000
    random = np.random.default_rng(0)
    columns = {
        "small variance around a large mean": 1e4 + random.normal(size=n),
        "a large mean that moves": 1e4 + random.normal(size=n) + np.linspace(0, 5, n),
        "small": 1e-4 * random.normal(size=n),
        "the largest": random.uniform(-1e10, 1e10, size=n),
        "one-hot": random.random(n) < 1e-3,
        "constant": np.full(n, 0.1),
        "constant and large": np.full(n, 12345.678),
    }
    obs = np.stack([*columns.values()], axis=1).astype(np.float32)
    batches = jnp.asarray(obs).reshape(-1, num_envs, len(columns))
    start = Statistics.start(len(columns))
    statistics, _ = jax.jit(lambda: jax.lax.scan(lambda s, batch: (normalised.add(s, batch), None), start, batches))()
    obs = obs.astype(np.float64)
    std = obs.std(axis=0)
    error = np.abs(statistics.moments.mean - obs.mean(axis=0))
    half_a_digit = 2.0**-24 * np.abs(obs.mean(axis=0))  # of float32
    assert np.all(error <= np.maximum(1e-6 * std, 1.01 * half_a_digit)), dict(zip(columns, error / std, strict=True))
    np.testing.assert_allclose(statistics.moments.variance, obs.var(axis=0), rtol=1e-5, atol=1e-12)
    np.testing.assert_array_equal(np.asarray(statistics.moments.variance)[-2:], 0)


def test_after_many_observations_the_moments_still_move():
    """Each changes them by less than half a digit of float32."""
    ones, zeros = Moments(mean=array(1), variance=array(1)), Moments(mean=array(0), variance=array(0))
    start = Statistics(seen=jnp.int32(100_000_000), moments=ones, cut_off=zeros)
    after = jax.jit(lambda: jax.lax.fori_loop(0, 1000, lambda _, s: normalised.add(s, array([3])), start))()
    np.testing.assert_allclose(after.moments.mean, 1 + 1000 * 2e-8, atol=1e-7)
    np.testing.assert_allclose(after.moments.variance, 1 + 1000 * (2**2 - 1) * 1e-8, atol=1e-7)


# Agents


O, A, B = 3, 2, 8
SEEN = array([100, -1, 0.001], [300, -1, 0.002], [200, 1, 0.004])
RELEASED = {f"{algo} released": preset_settings("released", algo, "cheetah") for algo in ("td3", "sac", "td7")}


@functools.cache
def parts(algo, normalize):
    algo, *preset = algo.split()
    settings = {} if not preset else {k: v for k, v in RELEASED[f"{algo} released"].items() if k != "updates_per_step"}
    config = make_agent_config(algo, hidden=(8, 8), normalize_observations=normalize, **settings)
    return make_parts(algo, config, O, A)


def raw_batch(seed=0) -> Transition:
    random = np.random.default_rng(seed)
    obs, next_obs = random.normal(size=(2, B, O)) * np.array([100, 1, 0.002]) + np.array([200, 0, 0])
    fields = (obs, random.uniform(-1, 1, (B, A)), random.normal(size=B), next_obs, random.random(B) < 0.8)
    return Transition(*(jnp.asarray(field, jnp.float32) for field in fields))


def assert_close(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6)


def test_an_agent_that_does_not_normalise_is_unchanged():
    for algo, row in BASELINES.items():
        off, own = parts(algo, False).agent, row.build(make_agent_config(algo, hidden=(8, 8)), O, A).agent
        state = jax.eval_shape(off.init, KEY)
        assert state == jax.eval_shape(own.init, KEY) and off.see(state, SEEN) == state
        assert not any("statistics" in path or "moments" in path for path in by_path(state))


@algorithm_rows.every(fast=("td3", "td7_sqt_tuple"))
def test_every_algorithm_has_the_state_of_its_agent_and_the_statistics(algo):
    on, off = (parts(algo, normalize).agent for normalize in (True, False))

    def after_update(agent):
        return jax.eval_shape(lambda: agent.update(agent.see(agent.init(KEY), SEEN), raw_batch(), KEY, jnp.int32(0)))

    (state, *results), (plain, *plain_results) = after_update(on), after_update(off)
    if hasattr(plain, "checkpoints"):
        state, plain = state.learner, plain.learner
    assert results == plain_results and state.learner == plain
    assert state.statistics == jax.eval_shape(lambda: Statistics.start(O))


@pytest.mark.parametrize(
    "algo", ["sac", *(pytest.param(a, marks=pytest.mark.slow) for a in ("td3_sqt", "td3 released", "sac released"))]
)
def test_an_agent_acts_and_learns_as_the_plain_one_does_on_normalised_observations(algo):
    on, off = parts(algo, True), parts(algo, False)
    moments = Moments(mean=SEEN.mean(axis=0), variance=SEEN.var(axis=0))
    raw = raw_batch()
    normal = raw._replace(obs=normalise(moments, raw.obs), next_obs=normalise(moments, raw.next_obs))

    def results(parts, state, batch):
        agent, views = parts.agent, parts.agent.views
        updated, *update = agent.update(state, batch, KEY, 1)
        learner = getattr(updated, "learner", updated)
        return updated, {
            "act": (agent.act(state, batch.obs, KEY), agent.act(state, batch.obs, KEY, deterministic=True)),
            "policy": views.policy_action(views.policy(state), batch.obs),
            "q_values": views.q_values(state, batch.obs, batch.action),
            "sample": views.sample(state, batch.obs, KEY) if views.sample else None,
            "td_target": parts.td_target(state, batch, parts.draw(KEY, batch)),
            "update": (update, learner.actor, learner.critic),
        }

    def both():
        state, plain = on.agent.see(on.agent.init(KEY), SEEN), off.agent.init(KEY)
        return state, results(on, state, raw), results(off, plain, normal)[1], results(off, plain, raw)[1]

    state, (updated, ours), expected, unlike = jax.jit(both)()
    assert_close(ours, expected)
    assert (ours["sample"] is not None) == algo.startswith("sac")
    for name in ("act", "policy", "q_values", "sample", "td_target"):
        for x, y in zip(jax.tree.leaves(ours[name]), jax.tree.leaves(unlike[name]), strict=True):
            assert x.shape == () or np.any(np.abs(x - y) > 1e-3), name
    assert_close(updated.statistics, state.statistics)  # an update does not change them


@pytest.mark.parametrize("algo", ["td7_sqt", pytest.param("td7 released", marks=pytest.mark.slow)])
def test_td7s_snapshot_and_checkpoint_keep_the_moments_they_were_made_with(algo):
    agent, plain = parts(algo, True).agent, parts(algo, False).agent.views
    obs, ended = raw_batch().obs, jnp.array([True])
    none, early = Statistics.start(O).moments, Moments(mean=SEEN.mean(axis=0), variance=SEEN.var(axis=0))

    @jax.jit
    def story():
        start = agent.see(agent.init(KEY), SEEN)
        once = agent.observe(start, array(5), ended, 0)
        later = agent.see(once, 2 * SEEN)
        twice = agent.observe(later, array(6), ended, 0)
        checkpoint = twice.checkpoints.checkpoint
        return (start, once, later, twice), {
            "evaluated": agent.act(twice, obs, KEY, deterministic=True),
            "saved": agent.views.policy_action(agent.views.policy(twice), obs),
            "by hand": plain.policy_action(checkpoint.policy, normalise(early, obs)),
            "snapshot": agent.views.policy_action(twice.checkpoints.snapshot, obs),
        }

    (start, once, later, twice), actions = story()
    late = later.learner.statistics.moments
    assert_close(late, functools.reduce(add, (SEEN, 2 * SEEN), Statistics.start(O)).moments)
    for state, snapshot, checkpoint in [
        (start, none, none),
        (once, early, none),
        (later, early, none),
        (twice, late, early),
    ]:
        assert_close(state.checkpoints.snapshot.moments, snapshot)
        assert_close(state.checkpoints.checkpoint.moments, checkpoint)
    assert_close(actions["evaluated"], actions["by hand"])
    assert_close(actions["saved"], actions["by hand"])
    assert np.any(np.abs(actions["snapshot"] - actions["by hand"]) > 1e-3)


def test_the_statistics_of_a_diverged_agent_stay():
    agent = parts("td3", True).agent
    state = jax.jit(lambda: agent.see(agent.init(KEY), SEEN))()
    diverged = state._replace(learner=state.learner._replace(diverged=jnp.array(True)))
    assert_close(agent.see(diverged, 2 * SEEN).statistics, state.statistics)
    assert agent.see(state, 2 * SEEN).statistics.seen == 6


# Training


TINY = {"steps": 60, "warmup_steps": 40, "batch_size": 16, "hidden": (16, 16), "eval_every": 20, "eval_episodes": 2}


@functools.cache
def trained(scale):
    """The final state and history of one seed that observes in this unit."""
    env = scaled_pendulum.make(scale)
    config = experiment.make_config("td3", env, normalize_observations=True, num_envs=2, **TINY)
    return jax.jit(experiment.make_train(config, env))(KEY)


def test_the_statistics_are_those_of_the_raw_observations_in_the_replay_and_not_of_evaluations():
    state, history = trained(1000)
    assert history.lengths.shape == (4, 2) and np.all(history.lengths == 200)  # evaluations observe too
    statistics, rows = state.agent.statistics, np.asarray(state.replay.storage[:, :3], np.float64)
    assert statistics.seen == len(rows) == state.replay.inserted == 60  # warm-up included
    assert 900 < np.abs(rows).max() < 8_000  # raw
    np.testing.assert_allclose(statistics.moments.mean, rows.mean(axis=0), rtol=1e-5, atol=0.01)
    np.testing.assert_allclose(statistics.moments.variance, rows.var(axis=0), rtol=1e-5)


@pytest.mark.slow
def test_the_unit_of_the_observations_changes_nothing():
    """Nearly: the variance has 1e-8 added to it, and numbers are rounded."""
    (state, history), (other, others) = trained(1), trained(1000)
    np.testing.assert_allclose(state.replay.storage[:, 3], other.replay.storage[:, 3], atol=1e-3)  # actions
    for x, y in zip(jax.tree.leaves(state.agent.learner), jax.tree.leaves(other.agent.learner), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-2, atol=1e-3)
    np.testing.assert_allclose(history.returns[1:], others.returns[1:], rtol=1e-3)
    assert np.any(np.abs(history.returns[0] - others.returns[0]) > 1)  # before the first observation


def test_it_is_counted_in_the_estimate_of_memory():
    config = experiment.make_config("td3", "cheetah", **TINY)
    on = experiment.make_config("td3", "cheetah", normalize_observations=True, **TINY)
    env = probe_envs.constant_reward()  # O = 2: a count, two moments, what rounding has cut off them
    more = experiment.memory_estimate(on, 1, env) - experiment.memory_estimate(config, 1, env)
    assert more == 2 * 4 * (1 + 4 * 2)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [10_000, 0.0001])
def test_a_task_in_another_unit_is_learned_with_it_and_not_without(scale):
    """experiments/results/normalisation.md in small: upright earns about -150, an untrained policy about -1,350."""
    env = scaled_pendulum.make(scale)
    settings = {"steps": 5_000, "warmup_steps": 1_000, "eval_every": 5_000, "eval_episodes": 10, "batch_size": 64}
    returns = {}
    for normalize in (True, False):
        config = experiment.make_config(
            "sac", env, hidden=(64, 64), lr=1e-3, normalize_observations=normalize, **settings
        )
        run = jax.jit(
            jax.vmap(experiment.make_train(config, env)), compiler_options={"xla_backend_optimization_level": 3}
        )
        returns[normalize] = run(jax.vmap(jax.random.key)(jnp.arange(3)))[1].returns[:, -1].mean(axis=-1)
    assert np.mean(returns[True]) > -500 and np.all(returns[False] < -900), returns


def test_the_library_has_it_too():
    agent = make_agent("td3", O, A, hidden=(8, 8), normalize_observations=True)
    state = jax.jit(lambda: agent.see(agent.init(KEY), SEEN))()
    assert jax.jit(agent.act)(state, SEEN, KEY).shape == (3, A) and state.statistics.seen == 3
