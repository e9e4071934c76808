"""Properties of every row of the table of algorithms: shapes, laws, clocks and members."""

import dataclasses
from functools import cache, partial
from typing import NamedTuple

import algorithm_rows
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from algorithm_rows import KINDS, ONE_OF_EACH

from sqt_jax import networks
from sqt_jax.agents import sac, td3, td7
from sqt_jax.algorithms import ALGORITHMS, default_agent_config, features_of, make_parts
from sqt_jax.config import SETTINGS, AgentConfig
from sqt_jax.gaussian import GaussianActor
from sqt_jax.types import Agent, Parts, Scalars, Transition

O, A, B = 3, 2, 16
KEY = jax.random.key(0)
VARIANTS = [name for name, row in ALGORITHMS.items() if row.baseline]
PLAIN = [name for name, row in ALGORITHMS.items() if not row.baseline]


BASES = [algo for algo in KINDS if algo in PLAIN]

every_algorithm = pytest.mark.parametrize("algo", ALGORITHMS)
every_kind = pytest.mark.parametrize("algo", KINDS)
every_plain = pytest.mark.parametrize("algo", PLAIN)
every_base = pytest.mark.parametrize("algo", BASES)
every_variant = pytest.mark.parametrize("algo", VARIANTS)


def base_of(algo):
    return ALGORITHMS[algo].baseline or algo


def test_no_agent_is_left_out():
    assert {ALGORITHMS[algo].build for algo in BASES} == {row.build for row in ALGORITHMS.values()}
    assert all(base_of(algo) in PLAIN for algo in VARIANTS)


def make_batch(seed, size=B) -> Transition:
    generator = np.random.default_rng(seed)
    obs, next_obs = generator.normal(size=(2, size, O))
    action, discount = generator.uniform(-1, 1, size=(size, A)), generator.random(size) < 0.8
    fields = (obs, action, generator.normal(size=size), next_obs, discount)
    return Transition(*(jnp.asarray(field, jnp.float32) for field in fields))


# For functions that run a few times only: compiles in half the time.
quick_jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


class Subject(NamedTuple):
    """An agent of a small size, and its functions compiled once for all tests."""

    config: AgentConfig
    parts: Parts
    agent: Agent
    update: jax.stages.Wrapped
    act: jax.stages.Wrapped


@cache
def subject(algo, **changes) -> Subject:
    sizes = {"hidden": (8, 8), "embedding_size": 8}
    config = dataclasses.replace(default_agent_config(algo), **sizes | changes)
    parts = make_parts(algo, config, O, A)
    compiler = quick_jit if changes else jax.jit  # the rows themselves as they are used
    act = quick_jit(parts.agent.act, static_argnames="deterministic")
    return Subject(config, parts, parts.agent, compiler(parts.agent.update), act)


@cache
def compiled_init(build):
    """Rows of one `build` start alike except for the number of critics: a start is compiled once for all of them."""
    return quick_jit(subject(next(algo for algo in BASES if ALGORITHMS[algo].build is build)).agent.init)


def start(algo, seed=0, scalars=None, **changes):
    """A first state; any number of critics is gathered out of starts with two each, which saves compilations.

    TD7's value bounds are open, as if targets had been seen.
    """
    config, _, agent, *_ = subject(algo, **changes)
    scalars = (scalars or config.scalars()).as_arrays()
    n = config.ensemble_size
    init = compiled_init(ALGORITHMS[algo].build)
    starts = [init(jax.random.key(seed + 1000 * i), scalars) for i in range(-(-n // 2))]

    def gather(like, *leaves):
        return leaves[0] if leaves[0].shape == like.shape else jnp.concatenate(leaves)[:n]

    state = jax.tree.map(gather, jax.eval_shape(agent.init, KEY), *starts)
    if hasattr(state, "learner"):
        bounds = td7.ValueBounds(*map(jnp.float32, (1e8, -1e8, -1e8, 1e8)))
        state = state._replace(learner=state.learner._replace(value_bounds=bounds))
    return state


def learner(state):
    """The state that learns: TD7's is inside its policy checkpoints."""
    return getattr(state, "learner", state)


def with_learner(state, **fields):
    if hasattr(state, "learner"):
        return state._replace(learner=state.learner._replace(**fields))
    return state._replace(**fields)


def run(algo, state, steps, **changes):
    """The states and metrics after each of a few updates."""
    states, metrics = [state], []
    for k in range(steps):
        state, _, measured = subject(algo, **changes).update(state, make_batch(k), jax.random.key(100 + k), k)
        states.append(state)
        metrics.append(measured)
    return states, metrics


def enough(algo):
    """Updates in which every network moves."""
    return max(4, 2 * subject(algo).config.policy_delay)


def numbers(tree):
    """A tree's leaves except typed keys, as NumPy arrays."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)]
    return [np.asarray(leaf) for leaf in leaves]


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(numbers(a), numbers(b), strict=True))


def assert_close(a, b, **tolerance):
    for x, y in zip(numbers(a), numbers(b), strict=True):
        np.testing.assert_allclose(x, y, **tolerance)


def learned(state):
    """A state without the scalars, in which a baseline and its variants differ."""
    return with_learner(state, scalars=None)


# Shapes and soundness


@every_variant
def test_a_variant_starts_exactly_as_its_baseline(algo):
    scalars = subject(algo).config.scalars()
    ours, plain = (jax.make_jaxpr(subject(name).agent.init)(KEY, scalars) for name in (algo, base_of(algo)))
    assert str(ours) == str(plain)


OWN_SIZES = [(algo, row.settings.get("ensemble_size", AgentConfig.ensemble_size)) for algo, row in ALGORITHMS.items()]
# Fast: one row of each agent and penalty as it is, one of each with 5 critics.
FAST = [(algo, n) for algo, n in OWN_SIZES if algo in ("td3", "sac", "redq", *ONE_OF_EACH)]
FAST += [(algo, n) for algo in ("td3", "sac_sqt") for n in (1, 5) if n == 5 or algo in BASES]
SLOW = [*OWN_SIZES, *((algo, n) for algo in KINDS for n in (1, 5) if n == 5 or algo in BASES)]
SIZES = [*FAST, *(pytest.param(*each, marks=pytest.mark.slow) for each in dict.fromkeys(SLOW) if each not in FAST)]


@pytest.mark.parametrize(("algo", "n"), SIZES)
def test_three_updates_are_finite_and_have_these_shapes(algo, n):
    changes = {} if (algo, n) in OWN_SIZES else {"ensemble_size": n}
    first = state = start(algo, **changes)
    update = subject(algo, **changes).update
    measured = []
    for k in range(max(3, subject(algo).config.policy_delay)):
        before = state
        state, td_error, metrics = update(state, make_batch(k), jax.random.key(k), k)
        measured.append(metrics)
        assert td_error.shape == (B,) and np.all(np.asarray(td_error) >= 0)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), state) == jax.tree.map(lambda x: (x.shape, x.dtype), before)
    assert all(np.all(np.isfinite(leaf)) for tree in (first, state) for leaf in numbers(tree))
    assert all(leaf.shape[0] == n for leaf in jax.tree.leaves(learner(state).critic))
    expected = {"critic_loss", "q_mean", "q_std", "td_error", "td_target", "penalty", "actor_loss"}
    for metrics in measured:
        assert expected <= set(metrics) and all(value.shape == () for value in metrics.values())
        assert np.isnan(metrics["q_std"]) == (n == 1)  # one critic has no disagreement to report
        assert (metrics["penalty"] > 0) == (algo in VARIANTS)
    finite = [{name for name, value in metrics.items() if np.isfinite(value)} for metrics in measured]
    assert set.union(*finite) >= expected - ({"q_std"} if n == 1 else set())


@every_algorithm
def test_dtypes_do_not_promote_by_accident(algo):
    """Everything except the optimizer's step, which is optax's."""
    config, parts, agent, *_ = subject(algo)
    state, batch = jax.eval_shape(agent.init, KEY), make_batch(0)
    with jax.numpy_dtype_promotion("strict"):
        draws = jax.eval_shape(parts.draw, KEY, batch)
        target, terms = jax.eval_shape(parts.td_target, state, batch, draws)
        action = jax.eval_shape(agent.act, state, batch.obs, KEY)
    assert target.shape == (B,) and target.dtype == action.dtype == jnp.float32
    assert terms["penalty"].shape == ((B,) if config.penalty == "transition_std" else ())


@every_algorithm
def test_update_of_the_agent_is_that_of_the_parts_with_its_own_draws(algo):
    """The same program, so that nothing needs to be compiled."""
    _, parts, agent, *_ = subject(algo)
    arguments = jax.eval_shape(agent.init, KEY), make_batch(0), KEY, jnp.int32(0)

    def with_draws(state, batch, key, step):
        return parts.update(state, batch, parts.draw(key, batch), step)

    assert str(jax.make_jaxpr(agent.update)(*arguments)) == str(jax.make_jaxpr(with_draws)(*arguments))


@every_base
def test_the_key_decides_the_draws(algo):
    parts = subject(algo).parts
    first, again, other = (parts.draw(jax.random.key(seed), make_batch(0)) for seed in (0, 0, 1))
    assert same(first, again) and not same(first, other)
    drawn = [leaf for leaf in numbers(first) if leaf.shape == (B, A)]
    assert len(np.unique(np.stack(drawn))) == len(drawn) * B * A  # no draw is used twice


@every_base
def test_the_seed_decides_the_start(algo):
    assert same(start(algo, seed=3), start(algo, seed=3))
    first, other = learner(start(algo, seed=3)), learner(start(algo, seed=4))
    for name in ("actor", "critic"):
        pairs = zip(numbers(getattr(first, name)), numbers(getattr(other, name)), strict=True)
        assert not any(np.array_equal(x, y) for x, y in pairs)
    for name in first._fields:
        if name.startswith("target_"):
            assert same(getattr(first, name), getattr(first, name.removeprefix("target_")))


# Acting


@every_base
def test_deterministic_actions_ignore_the_key(algo):
    act, state, obs = subject(algo).act, start(algo), make_batch(0).obs
    first, other = (act(state, obs, jax.random.key(seed), deterministic=True) for seed in (0, 1))
    np.testing.assert_array_equal(first, other)
    explored, again, differently = (act(state, obs, jax.random.key(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(explored, again)
    assert np.all(explored != differently) and np.all(explored != first)


@every_base
@pytest.mark.parametrize("deterministic", [True, False])
def test_actions_stay_within_their_limits(algo, deterministic):
    obs = 1e4 * make_batch(0, size=512).obs
    state = jax.tree.map(lambda leaf: 30 * leaf if leaf.ndim else leaf, start(algo))  # all weights
    action = subject(algo).act(state, obs, KEY, deterministic=deterministic)
    assert action.shape == (512, A)
    assert 0.99 < np.abs(action).max() <= 1


def test_td3_explores_with_its_noise():
    act, state, obs = subject("td3").act, start("td3"), jnp.zeros((4096, O))
    noise = act(state, obs, KEY) - act(state, obs, KEY, deterministic=True)
    assert abs(float(noise.mean())) < 0.005 and abs(float(noise.std()) - 0.1) < 0.005


def test_td3_smooths_the_target_action_within_its_clip():
    parts, state, batch = subject("td3").parts, start("td3"), make_batch(0)
    draws = np.asarray(parts.draw(KEY, make_batch(0, size=4096)).target_noise)
    assert abs(draws.std() - 0.2) < 0.01

    @quick_jit
    def target(scale):
        return parts.td_target(state, batch, td3.TD3Draws(jnp.full((B, A), scale), jnp.arange(2)))[0]

    np.testing.assert_array_equal(target(0.5), target(0.9))
    np.testing.assert_array_equal(target(-0.5), target(-0.9))
    assert not np.array_equal(target(0.5), target(0.4))


# The law of the coefficient


@every_variant
def test_coefficient_zero_is_the_baseline_bit_for_bit(algo):
    """For the target by arithmetic (test_q_targets); for the rest because XLA compiles both programs alike."""
    plain, _ = run(base_of(algo), start(base_of(algo)), enough(algo))
    ours, _ = run(algo, start(algo, scalars=subject(algo).config.scalars()._replace(penalty_coef=0.0)), enough(algo))
    assert same(learned(ours[-1]), learned(plain[-1]))


@every_variant
def test_a_positive_coefficient_changes_target_and_training(algo):
    assert subject(algo).config.penalty_coef > 0
    plain, plain_metrics = run(base_of(algo), start(base_of(algo)), enough(algo))
    ours, metrics = run(algo, start(algo), enough(algo))
    # The first update starts from equal critics: the mean target differs by gamma * mean(discount * penalty) exactly.
    assert metrics[0]["td_target"] < plain_metrics[0]["td_target"]
    assert not same(learner(ours[1]).critic, learner(plain[1]).critic)
    assert not same(learner(ours[-1]).actor, learner(plain[-1]).actor)


@every_variant
def test_the_target_is_the_baselines_target_minus_the_penalty(algo):
    inside, outside = subject(algo).parts, subject(algo, penalty_inside_gamma=False).parts
    plain, state, batch = subject(base_of(algo)).parts, start(algo), make_batch(0)

    @quick_jit
    def targets(state, batch):
        draws = plain.draw(KEY, batch)
        return [parts.td_target(state, batch, draws) for parts in (plain, inside, outside)]

    (theirs, _), (ours, terms), (ours_outside, terms_outside) = targets(state, batch)
    penalty = np.broadcast_to(terms["penalty"], B)
    assert np.all(penalty > 0) and same(terms["penalty"], terms_outside["penalty"])
    np.testing.assert_allclose(theirs - ours, 0.99 * batch.discount * penalty, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(theirs - ours_outside, penalty, rtol=1e-3, atol=1e-6)


# Clocks


def target_period(algo):
    """Updates between two moves of the target networks."""
    config = subject(algo).config
    periods = {td3.TD3State: config.policy_delay, sac.SACState: 1, td7.TD7State: config.target_update_period}
    return periods[type(learner(start(algo)))]


@every_plain
def test_the_actor_and_the_targets_move_only_when_they_should(algo):
    config = subject(algo).config
    states, metrics = run(algo, start(algo), 6)
    states = [learner(state) for state in states]
    for k, (before, after) in enumerate(zip(states, states[1:], strict=False), start=1):
        assert not same(before.critic, after.critic)
        due = k % config.policy_delay == 0
        assert same(before.actor, after.actor) == (not due)
        assert np.isnan(metrics[k - 1]["actor_loss"]) == (not due)
        targets = [name for name in before._fields if name.startswith("target_")]
        assert "target_critic" in targets
        for name in targets:
            assert same(getattr(before, name), getattr(after, name)) == (k % target_period(algo) != 0)


@pytest.mark.parametrize("algo", ["td3", "sac"])  # TD7's copies and actor: test_td7
def test_targets_make_soft_steps_towards_the_updated_networks(algo):
    scalars = subject(algo).config.scalars()._replace(tau=0.25)
    states, _ = run(algo, start(algo, scalars=scalars), 4)
    period = target_period(algo)
    for k in range(period, 5, period):
        before, after = states[k - 1], states[k]
        for name in [name for name in after._fields if name.startswith("target_")]:
            online = getattr(after, name.removeprefix("target_"))
            expected = jax.tree.map(lambda t, o: 0.75 * t + 0.25 * o, getattr(before, name), online)
            assert_close(getattr(after, name), expected, rtol=1e-5, atol=1e-7)


@every_base
def test_the_delayed_actor_is_a_real_branch_also_over_members(algo):
    """A loop of one iteration or none, whose condition has no axis of members."""
    config, parts, *_ = subject(algo)
    agent = parts.agent
    update = jax.vmap(agent.update, in_axes=(0, None, 0, None))
    states = jax.eval_shape(jax.vmap(agent.init), jax.random.split(KEY, 3))
    jaxpr = jax.make_jaxpr(update)(states, make_batch(0), jax.random.split(KEY, 3), jnp.int32(1))
    loops = [equation for equation in jaxpr.eqns if equation.primitive.name == "while"]
    assert len(loops) == {"td3": 1, "sac": config.policy_delay > 1, "td7": 2}[algo]  # TD7 copies its targets too
    assert all(any(x.aval.dtype == bool and x.aval.shape == () for x in loop.invars) for loop in loops)


@pytest.mark.parametrize("algo", ["td3", "sac"])  # TD7's copies and actor: test_td7
def test_the_actor_climbs_the_mean_of_the_updated_critics(algo):
    """Adam's first step has the sign of the gradient: of the mean over critics and batch, without an entropy term."""
    config, parts, *_ = subject(algo)
    states, _ = run(algo, start(algo, scalars=config.scalars()._replace(temperature=0.0)), config.policy_delay)
    k = config.policy_delay - 1  # the update that moved the actor
    batch, key, before, after = make_batch(k), jax.random.key(100 + k), states[k], states[k + 1]
    draws = parts.draw(key, batch)
    policies = {
        "td3": lambda actor: networks.TanhActor(A, config.hidden).apply(actor, batch.obs),
        "sac": lambda actor: GaussianActor(A, config.hidden).apply(actor, batch.obs).sample(draws.action_eps)[0],
    }
    critics = networks.ensemble(networks.Critic, 2, config.hidden)

    @quick_jit
    @jax.grad
    def climb(actor):
        return critics.apply(after.critic, batch.obs, policies[algo](actor)).mean()

    moved = jax.tree.map(lambda a, b: a - b, after.actor, before.actor)
    for step, slope in zip(numbers(moved), numbers(climb(before.actor)), strict=True):
        clear = np.abs(slope) > 1e-6
        assert clear.any()
        np.testing.assert_array_equal(np.sign(step[clear]), np.sign(slope[clear]))


@pytest.mark.parametrize("algo", [algo for algo in BASES if default_agent_config(algo).networks == "mlp"])
def test_layer_norm_is_in_the_critics_and_their_targets_only(algo):
    config = dataclasses.replace(default_agent_config(algo), layer_norm=True, hidden=(8, 8))
    state = jax.eval_shape(make_parts(algo, config, O, A).agent.init, KEY)
    layers = {*state.critic["params"]}
    assert {"norm0", "norm1"} <= layers == {*state.target_critic["params"]}
    assert not [name for name in state.actor["params"] if name.startswith("norm")]


@every_algorithm
def test_each_networks_first_step_has_the_learning_rates_length(algo):
    scalars = subject(algo).config.scalars()._replace(lr=1e-3)
    states, _ = run(algo, start(algo, scalars=scalars), subject(algo).config.policy_delay)
    states = [learner(state) for state in states]
    for name in ("critic", "actor"):
        moved = [state for state in states if not same(getattr(state, name), getattr(states[0], name))][0]
        steps = jax.tree.map(lambda a, b: jnp.max(jnp.abs(a - b)), getattr(moved, name), getattr(states[0], name))
        np.testing.assert_allclose(max(numbers(steps)), 1e-3, rtol=1e-2)  # Adam's: lr * gradient / |gradient|


# Members


@algorithm_rows.every(KINDS, fast=ONE_OF_EACH)
def test_members_in_a_sweep_train_as_each_member_alone_does(algo):
    agent, update = subject(algo).agent, subject(algo).update
    default = subject(algo).config.scalars()
    coefs = (0.0, 0.5, 1.0) if algo in VARIANTS else (0.0, 0.0, 0.0)
    settings = [
        default._replace(penalty_coef=coef, lr=lr, gamma=gamma, tau=tau, temperature=temperature)
        for coef, lr, gamma, tau, temperature in zip(
            coefs, (3e-4, 1e-3, 1e-2), (0.99, 0.9, 0.5), (0.005, 0.1, 0.5), (0.2, 0.1, 0.5), strict=True
        )
    ]
    alone = [start(algo, seed, scalars) for seed, scalars in enumerate(settings)]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *alone)
    update_all = quick_jit(jax.vmap(agent.update, in_axes=(0, 0, 0, None)))
    for k in range(4):
        batches = [make_batch(10 * k + i) for i in range(3)]
        keys = jax.random.split(jax.random.key(k), 3)
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *batches)
        together, td_error, _ = update_all(together, stacked, keys, k)
        own = [update(state, batch, key, k) for state, batch, key in zip(alone, batches, keys, strict=True)]
        alone = [state for state, _, _ in own]
        for i in range(3):
            np.testing.assert_allclose(td_error[i], own[i][1], rtol=1e-4, atol=1e-5)
    for i in range(3):
        member = jax.tree.map(lambda leaf, i=i: leaf[i], together)
        assert_close(member, alone[i], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", Scalars._fields)
@every_algorithm
def test_a_swept_scalar_shares_one_compilation_and_matters(algo, name):
    update = subject(algo).update
    default = subject(algo).config.scalars()
    updates = subject(algo).config.policy_delay
    before = run(algo, start(algo), updates)[0][-1]
    compilations = update._cache_size()
    after = run(algo, start(algo, scalars=default._replace(**{name: 0.7 * getattr(default, name) + 0.05})), updates)[0][
        -1
    ]
    assert update._cache_size() == compilations == 1
    unused = not set(SETTINGS[name].features) <= features_of(ALGORITHMS[algo], subject(algo).config)
    assert same(learned(after), learned(before)) == unused


# SAC's temperature


@pytest.fixture(scope="module")
def learning_temperature():
    """SAC with a learned temperature, and a start whose policy has a narrow or a wide standard deviation."""
    own = subject("sac", learn_temperature=True)
    first = quick_jit(
        lambda scalars: own.agent.init(KEY, scalars).log_temperature
    )  # the part of init that depends on scalars

    def make(log_std, temperature):
        scalars = own.config.scalars()._replace(lr=1e-2, temperature=temperature).as_arrays()
        state = start("sac", scalars=scalars)._replace(log_temperature=first(scalars))
        layer = {"kernel": jnp.zeros((8, A)), "bias": jnp.full(A, log_std)}
        return state._replace(actor={"params": state.actor["params"] | {"log_std": layer}})

    return own, make


@pytest.mark.parametrize(("log_std", "direction"), [(-3.0, 1), (0.0, -1)], ids=["narrow", "wide"])
def test_a_learned_temperature_moves_towards_its_entropy_target(learning_temperature, log_std, direction):
    own, make = learning_temperature
    state = make(log_std, temperature=0.3)
    seen = []
    for k in range(5):
        state, _, metrics = own.update(state, make_batch(k), jax.random.key(k), k)
        assert (metrics["entropy"] < -A) == (direction > 0)  # the target is minus the number of actions
        seen.append(float(metrics["temperature"]))
    np.testing.assert_allclose(seen[0], 0.3, rtol=1e-6)  # the scalar is where learning starts
    assert np.all(np.sign(np.diff(seen)) == direction)
    assert np.all(np.isfinite(seen)) and min(seen) > 0


def test_a_fixed_temperature_stays():
    _, metrics = run("sac", start("sac"), 3)
    np.testing.assert_array_equal([m["temperature"] for m in metrics], np.full(3, 0.2, np.float32))


def test_the_temperature_weighs_the_entropy_in_the_target():
    config, parts, *_ = subject("sac")
    default, batch = config.scalars(), make_batch(0)
    draws = parts.draw(KEY, batch)
    compute = quick_jit(parts.td_target)
    (without, _), (with_it, terms) = (
        compute(start("sac", scalars=default._replace(temperature=value)), batch, draws) for value in (0.0, 0.5)
    )
    expected = -0.99 * batch.discount * 0.5 * terms["next_log_prob"]
    np.testing.assert_allclose(with_it - without, expected, rtol=1e-4, atol=1e-5)


# Reductions


@every_base
def test_a_random_subset_of_critics_makes_the_target(algo):
    changes = {"ensemble_size": 5, "reduce": "subset_min", "subset_size": 2}
    parts, state, batch = subject(algo, **changes).parts, start(algo, ensemble_size=5), make_batch(0)
    draws = parts.draw(KEY, batch)
    assert draws.subset.shape == (2,) and len(set(draws.subset.tolist())) == 2
    compute = quick_jit(parts.td_target)
    indices = [(i, j) for i in range(5) for j in range(i, 5)]
    pairs = {pair: compute(state, batch, draws._replace(subset=jnp.array(pair)))[0] for pair in indices}
    for (i, j), target in pairs.items():
        np.testing.assert_allclose(target, np.minimum(pairs[i, i], pairs[j, j]), rtol=1e-5, atol=1e-6)
    assert not np.array_equal(pairs[0, 0], pairs[1, 1])


HUGE = 1e12  # finite, beyond `critic.LARGEST_VALUE`


def with_huge_values(state):
    """The same state with critics of this value everywhere."""
    params = learner(state).critic["params"]
    *_, last = sorted(params)
    layer = params[last] | {"bias": params[last]["bias"] + HUGE}
    return with_learner(state, critic={"params": params | {last: layer}})


FAULTS = {
    "a reward that is no number": lambda state, batch: (state, batch._replace(reward=batch.reward * jnp.nan)),
    "an infinite observation": lambda state, batch: (state, batch._replace(obs=batch.obs.at[2, 0].set(jnp.inf))),
    "values beyond all bounds": lambda state, batch: (with_huge_values(state), batch),
}


@every_kind
@pytest.mark.parametrize("fault", FAULTS)
def test_a_diverged_agent_never_changes_again(algo, fault):
    def parts(state, *without):
        return with_learner(state, **dict.fromkeys(("diverged", *without)))

    update, batch = subject(algo).update, make_batch(1)
    good = run(algo, start(algo), 3)[0][-1]
    state, bad = FAULTS[fault](good, batch)
    after, td_error, _ = update(state, bad, KEY, 3)
    assert after.diverged and not state.diverged
    assert not np.any(td_error)
    # TD7's encoder makes its step before the critics', which fail.
    encoder = [name for name in ("encoder", "encoder_opt") if hasattr(learner(state), name)]
    assert same(parts(after, *encoder), parts(state, *encoder))
    assert all(np.isfinite(leaf).all() for leaf in numbers(after))
    # Later updates change nothing, even valid ones.
    later = update(update(after, batch, KEY, 4)[0], batch, KEY, 5)[0]
    assert later.diverged and same(parts(later), parts(after))
