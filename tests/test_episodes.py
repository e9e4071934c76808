"""Played episodes are the same as evaluated ones, state by state."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probe_envs import constant_reward, countdown

from experiments.playing.episodes import CHUNK, configuration, ending, play
from sqt_jax import envs
from sqt_jax.envs.autoreset import make_environment
from sqt_jax.evaluate import evaluate_policy

KEY = jax.random.key(3)


def zeros(obs):
    return jnp.zeros((obs.shape[0], 1))


def counting(length_limit=200):
    """Episodes of 60 to 119 steps, drawn at the start; the reward is the number of the step."""

    def start(key):
        length = jax.random.randint(key, (), 60, 120)
        return (jnp.zeros((), jnp.int32), length), length[None].astype(jnp.float32)

    def advance(state, action):
        step, length = state[0] + 1, state[1]
        return (step, length), length[None].astype(jnp.float32), step.astype(jnp.float32), step >= length

    return make_environment("counting", 1, 1, length_limit, start, advance)


def test_each_episode_runs_to_its_own_end_and_shows_its_own_states():
    watched = []
    played = play(counting(), zeros, lambda t: (t.state.task[0], t.obs), KEY, num_episodes=5, watch=watched.append)
    lengths = [int(episode.shown[1][0, 0]) for episode in played]
    assert [episode.length for episode in played] == lengths and len(set(lengths)) > 2
    for episode, length in zip(played, lengths, strict=True):
        # the states in which the policy acted: the first, and none of the next episode
        np.testing.assert_array_equal(episode.shown[0], np.arange(length))
        assert (episode.shown[1] == length).all()
        assert episode.total == length * (length + 1) / 2
        assert (episode.terminated, episode.truncated) == (True, False)
        assert ending(episode) == "terminated by the task"
    assert watched == [CHUNK * (i + 1) for i in range(len(watched))] and watched[-1] >= max(lengths) > watched[-2]


@pytest.mark.parametrize(
    ("env", "max_steps", "length", "ends"),
    [
        (constant_reward(120), None, 120, "ended by the time limit"),
        (constant_reward(120), 7, 7, "cut off"),
        (constant_reward(120), 60, 60, "cut off"),
        (constant_reward(20), 60, 20, "ended by the time limit"),
        (countdown(3), 3, 3, "terminated by the task"),
        (countdown(3), 2, 2, "cut off"),
    ],
)
def test_how_episodes_end(env, max_steps, length, ends):
    (episode,) = play(env, zeros, lambda t: t.obs, KEY, max_steps=max_steps)
    assert (episode.length, episode.total, len(episode.shown), ending(episode)) == (length, length, length, ends)


def test_episodes_are_those_of_an_evaluation():
    env = envs.make("hopper", "mujoco")
    mix = jax.random.normal(jax.random.key(1), (env.observation_size, env.action_size))

    def policy(obs):
        return jnp.tanh(obs @ mix)

    played = play(env, policy, configuration, jax.random.key(5), num_episodes=3)
    returns, lengths = evaluate_policy(policy, env, num_episodes=3, seed=5)
    assert [episode.length for episode in played] == lengths.tolist()
    np.testing.assert_allclose([episode.total for episode in played], returns, rtol=1e-5)
    for episode in played:
        qpos, qvel = episode.shown
        assert qpos.shape == (episode.length, 6) and qvel.shape == (episode.length, 6)
        assert (abs(qpos[0, 2:]) <= 5e-3).all() and abs(qpos[-1, 2]) > 0.1  # from upright until it tips over
