"""The transitions of a lockstep step, and the counts of episodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probe_envs import constant_reward, countdown, one_step

from sqt_jax import rollout


def zeros(obs):
    return jnp.zeros((obs.shape[0], 1))


def play(env, steps, num_envs=2, policy=zeros, seed=0):
    """The time steps and transitions of a few steps."""
    timestep = jax.jit(lambda key: rollout.reset(env, key, num_envs))(jax.random.key(seed))
    step = jax.jit(lambda timestep: rollout.step(env, timestep, policy))
    timesteps, transitions = [timestep], []
    for _ in range(steps):
        timestep, transition = step(timestep)
        timesteps.append(timestep)
        transitions.append(transition)
    return timesteps, transitions


def test_environments_of_a_member_start_differently_and_a_key_repeats_them():
    env = constant_reward()
    first, again, other = (rollout.reset(env, jax.random.key(seed), 4).obs for seed in (0, 0, 1))
    assert first.shape == (4, env.observation_size)
    assert len(np.unique(first, axis=0)) == 4
    np.testing.assert_array_equal(first, again)
    assert not np.any(first == other)


def test_the_policy_sees_the_observation_and_its_action_is_stored():
    timesteps, transitions = play(one_step(), 2, policy=lambda obs: obs / 2)
    for timestep, following, transition in zip(timesteps, timesteps[1:], transitions, strict=False):
        np.testing.assert_array_equal(transition.obs, timestep.obs)
        np.testing.assert_array_equal(transition.action, timestep.obs / 2)
        np.testing.assert_allclose(transition.reward, (timestep.obs - (timestep.obs / 2) ** 2)[:, 0], rtol=1e-6)
        assert np.all(following.obs != timestep.obs)  # the next episode, with a start of its own


def test_termination_is_not_bootstrapped_and_next_obs_is_the_true_last_one():
    _, transitions = play(countdown(3), 4)
    for i, transition in enumerate(transitions):
        np.testing.assert_array_equal(transition.obs, np.full((2, 1), i % 3))
        np.testing.assert_array_equal(transition.next_obs, np.full((2, 1), i % 3 + 1))
        np.testing.assert_array_equal(transition.discount, np.full(2, i != 2))
        assert transition.discount.dtype == jnp.float32


def test_truncation_is_bootstrapped_from_the_true_last_observation():
    timesteps, transitions = play(constant_reward(2), 2)
    assert np.all(timesteps[2].truncated)
    for transition in transitions:
        np.testing.assert_array_equal(transition.discount, 1)
        np.testing.assert_array_equal(transition.next_obs, timesteps[0].obs)  # this task's observation is its start
    assert not np.any(timesteps[2].obs == timesteps[0].obs)


def test_episodes_are_counted_as_plain_python_does(maybe_jit):
    generator = np.random.default_rng(0)
    rewards, overs = generator.normal(size=(50, 3)).astype(np.float32), generator.random((50, 3)) < 0.2
    add = maybe_jit(lambda episodes, reward, over: episodes.add(reward, over))
    episodes, returns, lengths, ended = rollout.Episodes.start(3), np.zeros(3), np.zeros(3), []
    for reward, over in zip(rewards, overs, strict=True):
        episodes, so_far = add(episodes, reward, over)
        returns, lengths = returns + reward, lengths + 1
        np.testing.assert_allclose(so_far, returns, rtol=1e-4, atol=1e-5)  # with the reward of an episode's last step
        ended += [(returns[i], lengths[i]) for i in range(3) if over[i]]
        returns, lengths = np.where(over, 0, returns), np.where(over, 0, lengths)
    assert len(ended) > 10
    assert episodes.ended == len(ended)
    np.testing.assert_allclose(episodes.ended_return, sum(total for total, _ in ended), rtol=1e-4)
    assert episodes.ended_length == sum(length for _, length in ended)
    np.testing.assert_allclose(episodes.running_return, returns, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(episodes.running_length, lengths)


def test_forgetting_ended_episodes_keeps_the_running_ones():
    episodes, _ = rollout.Episodes.start(2).add(jnp.array([1.0, 2.0]), jnp.array([True, False]))
    episodes = episodes.forget_ended()
    assert episodes.ended == episodes.ended_return == episodes.ended_length == 0
    np.testing.assert_array_equal(episodes.running_return, [0, 2])
    np.testing.assert_array_equal(episodes.running_length, [0, 1])


@pytest.mark.parametrize("num_envs", [1, 3])
def test_warm_up_actions_are_uniform(num_envs):
    keys = jax.random.split(jax.random.key(0), 2000)
    actions = np.asarray(jax.vmap(lambda key: rollout.uniform_actions(key, num_envs, 2))(keys))
    assert actions.shape == (2000, num_envs, 2)
    assert np.abs(actions).max() <= 1
    assert len(np.unique(actions)) > 0.99 * actions.size  # each environment and entry its own draw
    np.testing.assert_allclose(actions.mean(axis=0), 0, atol=5 * (1 / 3 / 2000) ** 0.5)
    np.testing.assert_allclose(actions.var(axis=0), 1 / 3, atol=0.05)
