"""The training program: counters, seeds, compilations, the compiled text, learning on known values."""

import functools
import re

import algorithm_rows
import jax
import jax.numpy as jnp
import numpy as np
import probe_envs
import pytest

from sqt_jax import envs, experiment, q_targets, train
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.members import every_leaf

TINY = {
    "steps": 400,
    "warmup_steps": 40,
    "batch_size": 16,
    "hidden": (16, 16),
    "eval_every": 100,
    "eval_episodes": 2,
    "gamma": 0.9,
}
PENALISED = [name for name, row in ALGORITHMS.items() if row.settings.get("penalty", "none") != "none"]


@functools.cache
def make(algo, make_env=probe_envs.one_step, **settings):
    """Configuration, trainer and compiled sweep; the same ones for the same arguments."""
    config = experiment.make_config(algo, "cheetah", **TINY | settings)
    trainer = experiment.make_trainer(config, make_env())
    return config, trainer, train.make_sweep(trainer)


def start(config, sweep, seeds=(0, 1, 2), **swept):
    keys = jax.vmap(jax.random.key)(jnp.array(seeds, jnp.uint32))
    scalars = jax.tree.map(lambda value: jnp.full(len(seeds), value), config.agent.scalars())
    return sweep.init(keys, scalars._replace(**{name: jnp.array(values) for name, values in swept.items()}))


def advance(sweep, state, steps, learn):
    """The state after these steps, and the metrics over them."""
    state = sweep.advance(train.new_interval(state), steps, learn)
    return state, sweep.measure(state)


def numbers(tree):
    """Leaves as NumPy arrays, keys as the integers they hold."""
    return [
        np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)
        for leaf in jax.tree.leaves(tree)
    ]


def identical(a, b):
    return all(np.array_equal(x, y, equal_nan=True) for x, y in zip(numbers(a), numbers(b), strict=True))


@pytest.fixture(scope="module")
def td3():
    return make("td3")


def test_warmup_makes_steps_and_no_updates(td3):
    config, _, sweep = td3
    before = start(config, sweep)
    after, metrics = advance(sweep, start(config, sweep), 40, False)
    assert after.env_steps == 40 and after.gradient_steps == 0 and after.replay.inserted == 40
    assert identical(before.agent, after.agent)
    assert np.isnan(metrics["critic_loss"]).all() and (metrics["train_episodes"] == 40).all()
    actions = np.asarray(after.replay.storage[:, :40, 1])
    assert actions.min() < -0.8 and actions.max() > 0.8  # uniform, not the policy's


def test_training_makes_one_update_per_transition(td3):
    config, _, sweep = td3
    state, _ = advance(sweep, start(config, sweep), 40, False)
    state, metrics = advance(sweep, state, 30, True)
    assert state.env_steps == 70 and state.gradient_steps == 30
    assert all(np.isfinite(value).all() for value in metrics.values())


def test_updates_per_step_and_num_envs_multiply():
    config, _, sweep = make("td3", num_envs=4, updates_per_step=3)
    state, _ = advance(sweep, start(config, sweep), 10, False)
    assert state.env_steps == 40 and state.replay.inserted == 40
    state, _ = advance(sweep, state, 5, True)
    assert state.env_steps == 60 and state.gradient_steps == 5 * 4 * 3


def test_diverged_physics_are_counted_and_never_reach_the_replay():
    config, _, sweep = make("td3", probe_envs.diverging)
    state, metrics = advance(sweep, start(config, sweep), 40, False)
    rows = np.asarray(state.replay.storage[:, :40])  # obs, action, reward, discount, ...
    broken = rows[..., 1] > 0
    assert np.isfinite(rows).all() and broken.any(axis=1).all()
    np.testing.assert_array_equal(metrics["unstable_steps"], broken.sum(axis=1))
    np.testing.assert_array_equal(rows[..., 3], ~broken)  # the episode terminated
    np.testing.assert_array_equal(rows[..., 2], ~broken)  # with reward 0
    last = np.asarray(state.replay.final_obs)[np.asarray(state.replay.final_owner) >= 0]
    assert last.size and set(last.ravel()) <= set(rows[..., 0].ravel())  # this task's state never changes
    state, metrics = advance(sweep, state, 30, True)
    assert np.isfinite(metrics["critic_loss"]).all() and np.isfinite(state.replay.storage).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "physics"), [*((task, "mujoco") for task in envs.TASKS), ("hopper", "mjx"), ("cheetah", "mjx")]
)
def test_a_final_observation_is_kept_for_each_episode_and_no_other_step(task, physics):
    """If an episode's next observations were not the same numbers in both places, each would use room."""
    settings = {"hidden": (8, 8), "batch_size": 8, "steps": 1_200, "warmup_steps": 1_100, "physics": physics}
    config = experiment.make_config("td3", task, **settings)
    sweep = train.make_sweep(experiment.make_trainer(config))
    state, metrics = advance(sweep, start(config, sweep, (0, 1)), 1_020, False)
    over = state.timestep.terminated | state.timestep.truncated
    np.testing.assert_array_equal(state.replay.num_finals, metrics["train_episodes"] - over.sum(axis=1))
    assert np.all(metrics["train_episodes"] >= 1) and np.all(metrics["replay_rows"] == 1_020)


def test_any_number_of_steps_shares_one_compilation_of_the_warmup_and_one_of_training(td3):
    config, _, sweep = make.__wrapped__("td3")
    state = start(config, sweep)
    for steps, learn in [(7, False), (1, False), (5, True), (11, True)]:
        state, _ = advance(sweep, state, steps, learn)
        sweep.evaluate(state)
    assert sweep.advance._cache_size() == 2 and sweep.evaluate._cache_size() == 1


def test_a_sweep_over_scalars_shares_one_compilation():
    config, _, sweep = make.__wrapped__("td3_sqt")
    for coef in ([0.0, 0.5, 1.0], [0.1, 0.2, 0.3]):
        advance(sweep, start(config, sweep, penalty_coef=coef, lr=[1e-3, 1e-4, 1e-5]), 5, True)
    assert sweep.advance._cache_size() == 1


def test_chunks_change_nothing_at_all(td3):
    config, _, sweep = td3
    state = sweep.advance(start(config, sweep), 40, False)
    unbroken = sweep.advance(state, 20, True)
    state = sweep.advance(start(config, sweep), 25, False)
    for steps, learn in [(15, False), (3, True), (17, True)]:
        state = sweep.advance(state, steps, learn)
    assert identical(unbroken, state) and identical(sweep.measure(unbroken), sweep.measure(state))


def test_metrics_are_of_the_interval(td3):
    config, _, sweep = td3
    state, warm = advance(sweep, start(config, sweep), 40, False)
    parts = []
    for _ in range(3):
        state, metrics = advance(sweep, state, 1, True)
        parts.append(metrics)
    state, _ = advance(sweep, start(config, sweep), 40, False)
    state, metrics = advance(sweep, state, 3, True)
    for name in ("critic_loss", "q_mean", "q_std"):
        np.testing.assert_allclose(metrics[name], np.mean([part[name] for part in parts], axis=0), rtol=1e-5)
    # Only the second step updated the actor: the others do not count.
    np.testing.assert_allclose(metrics["actor_loss"], parts[1]["actor_loss"], rtol=1e-5)
    assert np.isnan(parts[0]["actor_loss"]).all() and np.isnan(warm["critic_loss"]).all()
    assert (metrics["train_episodes"] == 3).all() and (warm["train_episodes"] == 40).all()
    np.testing.assert_allclose(metrics["train_return"], np.mean([p["train_return"] for p in parts], axis=0), rtol=1e-5)


def test_means_of_long_intervals_keep_their_digits():
    values = jnp.float32(1000 + np.random.default_rng(0).normal(size=200_000))
    values = values.at[::7].set(jnp.nan)  # not measured
    means, _ = jax.lax.scan(lambda m, x: (m.add({"x": x}), None), train.Means.start({"x": jnp.zeros(())}), values)
    expected = np.nanmean(np.asarray(values, np.float64))
    assert abs(float(means.result()["x"]) - expected) < 1e-3


def test_members_differ_in_parameters_starts_and_noise(td3):
    config, _, sweep = td3
    state = start(config, sweep)
    for leaf in numbers((state.agent.actor, state.agent.critic, state.timestep.obs, state.key)):
        assert not np.array_equal(leaf[0], leaf[1])
    state, _ = advance(sweep, state, 40, False)
    state, _ = advance(sweep, state, 10, True)
    actions = np.asarray(state.replay.storage[:, :50, 1])
    assert not np.isclose(actions[0], actions[1]).any()


@pytest.mark.slow
def test_a_seed_starts_alone_as_in_a_sweep_bit_for_bit(td3):
    config, trainer, sweep = td3
    alone, together = start(config, sweep, (3,)), start(config, sweep, (0, 1, 2, 3))
    axes = every_leaf(trainer.member_axes, together)
    own = jax.tree.map(
        lambda leaf, axis: leaf if axis is None else leaf[3:], together, axes, is_leaf=lambda x: x is None
    )
    assert identical(alone, own)
    alone, _ = advance(sweep, alone, 40, False)
    together, _ = advance(sweep, together, 40, False)
    rows = alone.replay.storage[0], together.replay.storage[3]
    assert np.array_equal(rows[0][:, :2], rows[1][:, :2])  # obs, action
    np.testing.assert_allclose(rows[0][:, 2:], rows[1][:, 2:], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("algo", ["td3_sqt", pytest.param("sac_sqt_tuple", marks=pytest.mark.slow)])
def test_a_seed_trains_alone_as_in_a_sweep(algo):
    config, _, sweep = make(algo)
    results = []
    for seeds in [(3,), (0, 1, 2, 3)]:
        state, _ = advance(sweep, start(config, sweep, seeds), 40, False)
        state, _ = advance(sweep, state, 100, True)
        results.append((state.agent.critic, state.agent.actor, state.replay.storage))
    for alone, together in zip(numbers(results[0]), numbers(results[1]), strict=True):
        np.testing.assert_allclose(alone[0], together[3], rtol=1e-4, atol=1e-6)


@algorithm_rows.every(PENALISED, fast=("td3_sqt_tuple",))
def test_coef_0_trains_bit_identically_to_the_baseline_and_others_do_not(algo):
    plain = algo.removesuffix("_tuple").removesuffix("_sqt")
    trained = {}
    for name, coef in [(plain, 0.0), (algo, 0.0), (algo, 0.5)]:
        config, _, sweep = make(name, probe_envs.constant_reward)
        state, _ = advance(sweep, start(config, sweep, penalty_coef=[coef] * 3), 40, False)
        state, _ = advance(sweep, state, 60, True)
        learner = getattr(state.agent, "learner", state.agent)  # TD7's is inside its policy checkpoints
        trained[name, coef] = (learner.actor, learner.critic)
    assert identical(trained[plain, 0.0], trained[algo, 0.0])
    assert not identical(trained[plain, 0.0], trained[algo, 0.5])


def test_the_same_seeds_twice_are_bit_identical(td3):
    config, _, sweep = td3
    runs = []
    for _ in range(2):
        state, _ = advance(sweep, start(config, sweep), 40, False)
        runs.append(advance(sweep, state, 50, True))
    assert identical(*runs)


def test_evaluation_does_not_change_the_state_and_draws_new_starts_each_time(td3):
    config, _, sweep = td3
    state, _ = advance(sweep, start(config, sweep), 40, False)
    copy = numbers(state)
    first, _ = sweep.evaluate(state)
    assert all(np.array_equal(a, b) for a, b in zip(copy, numbers(state), strict=True))
    assert np.array_equal(first.returns, sweep.evaluate(state)[0].returns)
    state, _ = advance(sweep, state, 1, False)
    assert not np.isclose(first.returns, sweep.evaluate(state)[0].returns).any()


def test_the_compiled_text_writes_the_replay_in_place():
    config, _, sweep = make("td3", steps=100_000, replay_capacity=54_321)
    text = sweep.advance.lower(start(config, sweep), 1, True).compile().as_text()
    shape = r"f32\[3,54321,5\]"  # obs, action, reward, discount, where the final observation is
    made = [line for line in text.splitlines() if re.search(rf"= {shape}\S* (\w|-)+\(", line)]
    kinds = {re.search(rf"{shape}\S* ([\w-]+)\(", line).group(1) for line in made}
    assert "dynamic-update-slice" in kinds
    assert kinds <= {"dynamic-update-slice", "fusion", "get-tuple-element", "parameter", "bitcast"}, kinds
    assert len([line for line in made if " fusion(" in line]) <= 1  # the insert


def test_make_train_under_vmap_is_the_sweep(td3):
    config, trainer, sweep = td3
    run = jax.jit(jax.vmap(experiment.make_train(config, probe_envs.one_step())))
    keys = jax.vmap(jax.random.key)(jnp.arange(3, dtype=jnp.uint32))
    final, history = run(keys)
    assert history.env_steps[0].tolist() == [0, 100, 200, 300, 400]
    assert history.returns.shape == (3, 5, 2)
    state = start(config, sweep)
    returns = [sweep.evaluate(state)[0].returns]
    for first, last in zip(range(0, 400, 100), range(100, 401, 100), strict=True):
        state = train.new_interval(state)
        for steps, learn in train.segments(first, last, config.train):
            state = sweep.advance(state, steps, learn)
        metrics = sweep.measure(state)
        returns.append(sweep.evaluate(state)[0].returns)
    np.testing.assert_allclose(history.returns, jnp.stack(returns, 1), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(history.metrics["critic_loss"][:, -1], metrics["critic_loss"], rtol=1e-2)
    assert np.isnan(history.metrics["critic_loss"][:, 0]).all()
    assert (final.env_steps == 400).all()


def test_evaluation_steps_and_segments():
    config = experiment.make_config("td3", "cheetah").train
    stops = train.evaluation_steps(config)
    assert len(stops) == 201 and stops[:2] == [0, 5000] and stops[-1] == 1_000_000
    assert train.segments(20_000, 25_000, config) == [(5000, False)]
    assert train.segments(25_000, 30_000, config) == [(5000, True)]
    odd = experiment.make_config(
        "td3", "cheetah", steps=30_000, warmup_steps=7_000, eval_every=20_000, num_envs=2
    ).train
    assert train.evaluation_steps(odd) == [0, 20_000, 30_000]
    assert train.segments(0, 20_000, odd) == [(3500, False), (6500, True)]


def test_memory_estimate_is_the_size_of_replay_and_agents():
    config, _, sweep = make("td3")
    state = start(config, sweep)
    agent = sum(leaf.nbytes for leaf in numbers(state.agent))
    estimate = experiment.memory_estimate(config, 3, probe_envs.one_step())
    held = sum(leaf.nbytes for leaf in numbers(state.replay))
    assert estimate == pytest.approx(held + 2 * agent, rel=0.01)


def optimised(sweep, state):
    """The sweep compiled for speed, for tests that train for long (conftest: by default tests compile quickly)."""
    options = {"xla_backend_optimization_level": 3}
    programs = {learn: sweep.advance.lower(state, 1, learn).compile(options) for learn in (False, True)}
    return sweep._replace(advance=lambda state, steps, learn: programs[learn](state, steps))


LEARN = {
    "updates_per_step": 1,
    "steps": 3000,
    "warmup_steps": 200,
    "batch_size": 64,
    "hidden": (32, 32),
    "lr": 2e-3,
    "tau": 0.05,
}


@algorithm_rows.every(fast=("sac_sqt",))
def test_every_algorithm_finds_the_known_values_and_the_best_action(algo):
    """On `one_step` the best action is obs and Q is the reward, whatever the penalty: every step is terminal."""
    settings = LEARN | {"temperature": 0.01}
    if ALGORITHMS[algo].settings.get("networks") == "sale":
        settings |= {"target_update_period": 50, "embedding_size": 16}
    config, trainer, sweep = make(
        algo, **{name: v for name, v in settings.items() if algorithm_rows.has_effect(algo, name)}
    )
    state = start(config, sweep)
    sweep = optimised(sweep, state)
    state, _ = advance(sweep, state, 200, False)
    state, _ = advance(sweep, state, 1300, True)
    state, metrics = advance(sweep, state, 200, True)
    obs = jnp.linspace(-0.4, 0.4, 5)[:, None]
    agent = experiment.agent_of(config, probe_envs.one_step())
    act = jax.vmap(lambda s: agent.views.policy_action(agent.views.policy(s), obs))
    np.testing.assert_allclose(np.median(act(state.agent), axis=0), obs, atol=0.1)
    assert np.median(metrics["td_error"]) < 0.1  # targets are rewards, which are the true values
    assert (metrics["train_length"] == 1).all()


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["td3", "sac"])
def test_truncation_bootstraps_and_termination_does_not(algo):
    """Endless reward 1 is worth 1 / (1 - gamma) where only the time limit ends episodes; 3 steps 1 + g + g²."""
    values = {}
    for env in (probe_envs.constant_reward, probe_envs.countdown):
        settings = LEARN | {"tau": 0.1} | ({"temperature": 0.001} if algo == "sac" else {})
        config, _, sweep = make(algo, env, **settings)
        state = start(config, sweep)
        sweep = optimised(sweep, state)
        state, _ = advance(sweep, state, 200, False)
        state, _ = advance(sweep, state, 2000, True)
        state, metrics = advance(sweep, state, 200, True)
        values[env] = np.median(metrics["q_mean"])
    assert values[probe_envs.constant_reward] == pytest.approx(10, rel=0.1)
    # the mean over the three states
    assert values[probe_envs.countdown] == pytest.approx((1 + 1.9 + 2.71) / 3, rel=0.1)


def test_an_environment_may_have_any_field_names():
    """`inserted` is a shared counter in the replay, and each member's own number in an environment."""
    config, _, sweep = make("td3", probe_envs.with_a_field_called_inserted)
    state, metrics = advance(sweep, start(config, sweep), 50, True)
    assert state.timestep.state.task.inserted.shape == (3, 1) and (metrics["train_episodes"] > 0).all()


def test_a_member_that_diverges_is_frozen_and_the_others_continue(td3):
    config, _, sweep = td3
    healthy, seeds = start(config, sweep, range(5)), range(5)
    healthy = sweep.advance(sweep.advance(healthy, 40, False), 20, True)
    hurt = start(config, sweep, seeds)
    hurt = sweep.advance(sweep.advance(hurt, 40, False), 20, True)
    before = jax.tree.map(lambda x: np.array(x), hurt.agent)  # copies: the memory is donated
    storage = hurt.replay.storage.at[2].set(jnp.nan)
    hurt = sweep.advance(hurt._replace(replay=hurt.replay._replace(storage=storage)), 30, True)
    healthy = sweep.advance(healthy, 30, True)
    np.testing.assert_array_equal(hurt.diverged_at, [-1, -1, 61, -1, -1])
    np.testing.assert_array_equal(hurt.agent.diverged, np.arange(5) == 2)
    others = np.array([0, 1, 3, 4])
    for name in ("actor", "critic", "target_actor", "target_critic", "actor_opt", "critic_opt"):
        ours, theirs = (numbers(getattr(state.agent, name)) for state in (hurt, healthy))
        for a, b, frozen in zip(ours, theirs, numbers(getattr(before, name)), strict=True):
            np.testing.assert_array_equal(a[others], b[others])
            np.testing.assert_array_equal(a[2], frozen[2])
    np.testing.assert_array_equal(hurt.timestep.obs[others], healthy.timestep.obs[others])
    assert np.isfinite(hurt.timestep.obs).all()


@pytest.mark.slow
def test_the_bias_distinguishes_overestimation_from_underestimation(monkeypatch):
    """The true value is 5 everywhere. The largest of five critics overestimates, a strong penalty underestimates."""
    settings = {"ensemble_size": 5, "warmup_steps": 100, "lr": 3e-3, "tau": 0.1, "gamma": 0.8, "steps": 1_000}
    found = {}
    for name in ("largest", "smallest"):
        with monkeypatch.context() as patch:
            if name == "largest":
                patch.setitem(q_targets.REDUCTIONS, "min", lambda q, subset: jnp.max(q, axis=0))
            config, _, sweep = make.__wrapped__(
                "td3_sqt", functools.partial(probe_envs.constant_reward, 60), **settings
            )
            coefs = [0.0] * 3 if name == "largest" else [2.0] * 3
            state = sweep.advance(start(config, sweep, penalty_coef=coefs), 100, False)
            state = sweep.advance(state, 900, True)
            found[name] = {key: np.asarray(value) for key, value in sweep.evaluate(state)[1].items()}
    largest, smallest = found["largest"], found["smallest"]
    assert (largest["value_bias"] > 0).all() and (smallest["value_bias"] < 0).all()
    for biases in found.values():
        assert (biases["value_bias_min"] < biases["value_bias"]).all()
        np.testing.assert_allclose(biases["value_bias_normalised"], biases["value_bias"] / 5, rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["sac", "td7"])
def test_the_bias_is_measured_for_the_policy_whose_values_critics_estimate(algo):
    """SAC's critics by its samples, entropy included; TD7's by the policy checkpoint, which evaluation plays."""
    small = {"embedding_size": 16} if algo == "td7" else {}
    config, _, sweep = make(algo, functools.partial(probe_envs.countdown, 3), **small)
    state = sweep.advance(start(config, sweep), 40, False)
    state = sweep.advance(state, 60, True)
    evaluation, bias = sweep.evaluate(state)
    assert evaluation.returns.shape == (3, config.train.eval_episodes)
    assert np.isfinite(bias["value_bias"]).all()
    obs = jnp.array([[0.0], [1.0], [2.0]])
    agent = experiment.agent_of(config, probe_envs.countdown(3))
    for member in range(3):
        own = jax.tree.map(lambda x, m=member: x[m] if x.ndim else x, state.agent)
        if algo == "sac":
            # The bonus of an action is -temperature log pi: on average over many, the same along each episode.
            _, bonus = agent.views.sample(own, jnp.repeat(obs, 4_000, axis=0), jax.random.key(1))
            bonus = np.mean(np.asarray(bonus).reshape(3, -1), axis=1)
        else:
            assert agent.views.sample is None
            bonus = np.zeros(3)
        truth = np.array([1 + 0.9 * (bonus[1] + 1 + 0.9 * (bonus[2] + 1)), 1 + 0.9 * (bonus[2] + 1), 1.0])
        action = agent.act(own, obs, jax.random.key(0), deterministic=True)
        q = np.asarray(agent.views.q_values(own, obs, action)).mean(axis=0)
        assert bias["value_bias"][member] == pytest.approx(np.mean(q - truth), abs=0.3 if algo == "sac" else 1e-3)
