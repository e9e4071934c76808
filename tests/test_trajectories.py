"""Comparisons from the same states and actions find equal environments equal, and detect faults."""

from functools import cache

import jax.numpy as jnp

from experiments.gymnasium_parity import trajectories
from experiments.gymnasium_parity.gymnasium_reference import record_episode
from sqt_jax import envs


@cache
def swimmer():
    return envs.make("swimmer", "mujoco"), [record_episode("swimmer", 0, 1.0, steps=30)]


def test_complete_episodes_are_equal_and_a_fault_is_detected():
    env, episodes = swimmer()
    found = trajectories.compare_episodes(env, episodes)
    assert found.steps == 30 and found.terminations_agree
    assert found.obs < 1e-6 and found.reward < 1e-6

    def faulty(timestep, action):
        timestep = env.step(timestep, action)
        return timestep._replace(reward=timestep.reward + 0.5, terminated=jnp.array(True))

    found = trajectories.compare_episodes(env._replace(step=faulty), episodes)
    assert found.obs < 1e-6 and found.reward > 0.1 and not found.terminations_agree


def test_single_steps_are_near_and_a_fault_is_detected():
    env, _ = swimmer()
    found = trajectories.compare_steps("swimmer", env, 16)
    assert max(found[:6]) < 1e-5 and found.terminations_agree == 1

    def weaker(timestep, action):
        return env.step(timestep, 0.9 * action)

    found = trajectories.compare_steps("swimmer", env._replace(step=weaker), 16)
    assert found.qvel_median > 1e-3 and found.reward_median > 1e-6
