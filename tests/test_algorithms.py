"""The table of algorithms: its names, its rows, and the functions that belong to a name."""

import dataclasses

import algorithm_rows
import jax
import jax.numpy as jnp
import pytest
from probe_envs import constant_reward

from sqt_jax import lap
from sqt_jax.agents import sac, td3, td7
from sqt_jax.agents.policy_checkpoints import CheckpointedState
from sqt_jax.algorithms import ALGORITHMS, BASELINES, default_agent_config, make_agent, make_parts
from sqt_jax.config import FEATURES, SETTINGS, AgentConfig, TrainConfig
from sqt_jax.experiment import agent_of, make_config, make_train, make_trainer, replay_of
from sqt_jax.ring import RingState
from sqt_jax.settings import ConfigError, settings_of
from sqt_jax.types import Transition

VARIANTS = {"": ("none", 0.0), "_sqt": ("batch_std", 0.5), "_sqt_tuple": ("transition_std", 0.1)}
PAPERS_NINE = {"td3": td3, "sac": sac, "td7": td7}  # each with all variants
EARLIER = {"maxmin": td3, "redq": sac}  # with and without _sqt
NAMES = {base + suffix: module for base, module in PAPERS_NINE.items() for suffix in VARIANTS} | {
    base + suffix: module for base, module in EARLIER.items() for suffix in ("", "_sqt")
}
STATES = {td3: td3.TD3State, sac: sac.SACState, td7: CheckpointedState}
TD7 = [name for name, module in NAMES.items() if module is td7]


def base_of(algo):
    return ALGORITHMS[algo].baseline or algo


def test_the_table_has_these_names():
    assert set(ALGORITHMS) >= set(NAMES)


@pytest.mark.parametrize("algo", NAMES)
def test_each_name_is_its_baselines_agent_with_its_variants_penalty(algo):
    agent = make_config(algo, "ant").agent
    state = jax.eval_shape(make_agent(algo, 3, 2).init, jax.random.key(0))
    assert isinstance(state, STATES[NAMES[algo]])
    assert (agent.penalty, agent.penalty_coef) == VARIANTS[algo.removeprefix(base_of(algo))]


@pytest.mark.parametrize("algo", [name for name, row in ALGORITHMS.items() if row.baseline])
def test_a_variant_differs_from_its_baseline_only_in_the_penalty(algo):
    ours, plain = make_config(algo, "ant").flat(), make_config(base_of(algo), "ant").flat()
    assert {name for name in ours if ours[name] != plain[name]} == {"algo", "penalty", "penalty_coef"}
    fields = ("build", "build_released", "features", "training", "follows")
    row, base_row = ALGORITHMS[algo], ALGORITHMS[base_of(algo)]
    assert all(getattr(row, field) == getattr(base_row, field) for field in fields)


@pytest.mark.parametrize(
    ("algo", "base", "differences"),
    [
        ("maxmin", "td3", {"ensemble_size": 4}),
        ("redq", "sac", {"ensemble_size": 10, "reduce": "subset_min", "updates_per_step": 5, "policy_delay": 5}),
    ],
)
def test_the_earlier_ensembles_are_settings_of_td3_and_sac(algo, base, differences):
    ours, theirs = make_config(algo, "ant").flat(), make_config(base, "ant").flat()
    assert {name: ours[name] for name in ours if ours[name] != theirs[name]} == {"algo": algo} | differences
    assert ours["subset_size"] == 2


@pytest.mark.parametrize("algo", [name for name in NAMES if name not in TD7])
def test_sale_networks_make_the_same_actions_in_td7s_update_without_its_checkpoints(algo):
    settings = {"networks": "sale", "hidden": (5, 4), "embedding_size": 6}
    agent = make_agent(algo, 3, 2, **settings)
    state = jax.eval_shape(agent.init, jax.random.key(0))
    assert isinstance(state, td7.TD7State)
    assert ("log_std" in state.actor["params"]) == (NAMES[algo] is sac)
    batch = Transition(*(jnp.zeros(shape) for shape in ((4, 3), (4, 2), (4,), (4, 3), (4,))))
    draws, plain_draws = (
        jax.eval_shape(
            make_parts(algo, dataclasses.replace(default_agent_config(algo), **changes), 3, 2).draw,
            jax.random.key(0),
            batch,
        )
        for changes in (settings, {})
    )
    assert draws == plain_draws


@pytest.mark.parametrize("algo", TD7)
def test_td7_has_its_own_networks(algo):
    assert make_config(algo, "ant").agent.networks == "sale"
    with pytest.raises(ConfigError, match=f"--networks: expects sale for {algo}$"):
        make_config(algo, "ant", networks="mlp")


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_rows_name_settings_that_exist(algo):
    row = ALGORITHMS[algo]
    assert set(row.settings) | set(row.follows) <= set(settings_of(AgentConfig))
    assert set(row.training) | set(row.follows.values()) <= set(settings_of(TrainConfig))
    assert row.features <= set(FEATURES)
    assert row.baseline is None or row.baseline in BASELINES


def test_every_feature_belongs_to_an_algorithm_and_to_a_setting():
    assert {feature for about in SETTINGS.values() for feature in about.features} == set(FEATURES)


def test_settings_override_the_row():
    agent = make_config("td3_sqt", "ant", penalty_coef=0.25, policy_delay=3).agent
    assert (agent.penalty_coef, agent.policy_delay, agent.penalty) == (0.25, 3, "batch_std")
    assert make_config("redq", "ant", updates_per_step=20).train.updates_per_step == 20


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_any_penalty_but_that_of_the_algorithms_name_is_rejected(algo):
    """Otherwise a run would train another algorithm than its name says."""
    own = make_config(algo, "ant").agent.penalty
    for penalty in ("none", "batch_std", "transition_std"):
        if penalty == own:
            assert make_config(algo, "ant", penalty=penalty) == make_config(algo, "ant")
        else:
            with pytest.raises(ConfigError, match="--penalty: "):
                make_config(algo, "ant", penalty=penalty)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_several_environments_are_rejected_for_td7_only(algo):
    settings = {"num_envs": 4, "warmup_steps": 400, "eval_every": 400, "steps": 4000}
    if algo in TD7:
        with pytest.raises(ConfigError, match=f"--num_envs: expects 1 for {algo}, ") as error:
            make_config(algo, "ant", **settings)
        assert error.value.setting == "num_envs"
    else:
        assert make_config(algo, "ant", **settings).train.num_envs == 4


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_custom_environment_gives_the_sizes(algo):
    env = constant_reward()
    config = make_config(algo, "ant", hidden=(5,), ensemble_size=3, replay_capacity=300)
    agent = jax.eval_shape(agent_of(config, env).init, jax.random.key(0))
    assert jax.tree.leaves(getattr(agent, "learner", agent).critic)[1].shape == (
        3,
        env.observation_size + env.action_size,
        5,
    )
    state = jax.eval_shape(make_trainer(config, env).init, jax.random.key(0))
    assert jax.tree.structure(state.agent) == jax.tree.structure(agent)
    storage = (state.replay.rows if algo in TD7 else state.replay).storage
    assert storage.shape == (300, env.observation_size + env.action_size + 3)


@algorithm_rows.every(fast=algorithm_rows.ONE_OF_EACH)
def test_every_row_makes_a_complete_run(algo):
    """Traced, not compiled: every part of the row fits the train loop."""
    env = constant_reward()
    config = make_config(algo, "ant", hidden=(5, 4), steps=1000, warmup_steps=300, eval_every=500, eval_episodes=2)
    state, history = jax.eval_shape(jax.vmap(make_train(config, env)), jax.random.split(jax.random.key(0), 3))
    assert history.returns.shape == (3, 3, 2)
    assert state.gradient_steps.shape == (3,)
    needed = {"critic_loss", "actor_loss", "q_mean", "q_std", "penalty", "td_target", "td_error", "train_return"}
    own = {
        td3: set(),
        sac: {"temperature", "entropy"},
        td7: {"encoder_loss", "assessments", "policy_checkpoint_refreshes"},
    }
    assert needed | own[NAMES[algo]] <= set(history.metrics)
    assert all(value.shape == (3, 3) for value in history.metrics.values())


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_only_td7s_replay_is_lap_with_the_agents_settings(algo):
    env = constant_reward()
    if algo not in TD7:
        state = replay_of(make_config(algo, "ant", replay_capacity=300), env).init()
        assert isinstance(state, RingState)
        return
    settings = {"priority_exponent": 0.5, "min_priority": 4.0, "target_update_period": 3}
    buffer = replay_of(make_config(algo, "ant", replay_capacity=300, **settings), env)
    state = buffer.init()
    assert isinstance(state, lap.LapState)
    rows = jnp.arange(2)
    one = Transition(*(jnp.zeros((1, size)) for size in (2, 1)), jnp.zeros(1), jnp.zeros((1, 2)), jnp.ones(1))
    for _ in rows:
        state = buffer.insert(state, one)
    state = buffer.feedback(state, rows, jnp.array([0.0, 25.0]), jnp.int32(1))
    assert state.levels[0][0, :2].tolist() == [2, 5]  # max(error, 4) ** 0.5
    state = buffer.feedback(state, rows, jnp.zeros(2), jnp.int32(2))
    assert state.max_priority == 5
    assert buffer.feedback(state, rows, jnp.zeros(2), jnp.int32(3)).max_priority == 2  # refreshed every 3 updates


def test_what_is_no_environment_is_rejected():
    for env in (3, None, object()):
        with pytest.raises(ConfigError, match="--env: expects a name or an Environment, not "):
            make_config("td3", env)
    config = make_config("td3", constant_reward())
    with pytest.raises(ValueError, match="env: expects an Environment, not str"):
        make_train(config, "point")
    with pytest.raises(ValueError, match="an environment of your own called constant_reward, given: none"):
        make_trainer(config)
