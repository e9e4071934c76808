"""The table of algorithms: its names, its rows, and that the functions of a name are those of its row."""

import jax
import pytest
from probe_envs import constant_reward

from sqt_jax.agents import sac, td3
from sqt_jax.algorithms import AGENT_SETTINGS, ALGORITHMS, agent_of, make_config, make_trainer

VARIANTS = {"": ("none", 0.0), "_sqt": ("batch_std", 0.5), "_sqt_tuple": ("transition_std", 0.1)}


@pytest.mark.parametrize(("base", "module"), [("td3", td3), ("sac", sac)])
@pytest.mark.parametrize("suffix", VARIANTS)
def test_every_base_has_its_variants(base, module, suffix):
    row, agent = ALGORITHMS[base + suffix], make_config(base + suffix, "ant").agent
    assert row.make_agent is module.make
    assert (agent.penalty, agent.penalty_coef) == VARIANTS[suffix]


@pytest.mark.parametrize("algo", [name for name in ALGORITHMS if "_sqt" in name])
def test_a_variant_differs_from_its_base_by_the_penalty_alone(algo):
    ours, plain = make_config(algo, "ant").flat(), make_config(algo.split("_sqt")[0], "ant").flat()
    assert {name for name in ours if ours[name] != plain[name]} == {"algo", "penalty", "penalty_coef"}


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_rows_name_settings_that_exist(algo):
    assert set(ALGORITHMS[algo].settings) <= AGENT_SETTINGS


def test_settings_override_the_row():
    agent = make_config("td3_sqt", "ant", penalty_coef=0.25, policy_delay=3, penalty="transition_std").agent
    assert (agent.penalty_coef, agent.policy_delay, agent.penalty) == (0.25, 3, "transition_std")


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_an_environment_of_ones_own_gives_the_sizes(algo):
    env = constant_reward()
    config = make_config(algo, "ant", hidden=(5,), ensemble_size=3, replay_capacity=300)
    agent = jax.eval_shape(agent_of(config, env).init, jax.random.key(0))
    assert jax.tree.leaves(agent.critic)[1].shape == (3, env.observation_size + env.action_size, 5)
    state = jax.eval_shape(make_trainer(config, env).init, jax.random.key(0))
    assert jax.tree.structure(state.agent) == jax.tree.structure(agent)
    assert state.replay.storage.shape == (300, 2 * env.observation_size + env.action_size + 2)
