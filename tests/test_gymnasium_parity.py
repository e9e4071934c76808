"""Our environments against Gymnasium's own, from the same states and actions.

On MuJoCo C complete episodes are equal, to float32; on MJX single control steps are close (all tasks: `-m slow`).
"""

import gymnasium
import numpy as np
import pytest
from gym_reference import MJX_TASKS, environment, ours, recorded

from experiments.gymnasium_parity.gymnasium_reference import gymnasium_environment, record_episode
from experiments.gymnasium_parity.parity_report import EPISODES
from experiments.gymnasium_parity.trajectories import compare_episodes
from sqt_jax import envs
from sqt_jax.envs import TASKS

# Of the humanoid's last 84 observed numbers, contact forces of up to thousands of newtons, the error is relative.
FORCES = {"humanoid": 84, "humanoid-v5": 78, "humanoid_standup": 84, "humanoid_standup-v5": 78}


OTHERS = [pytest.param(name, marks=pytest.mark.slow) for name in TASKS if name not in MJX_TASKS]


@pytest.fixture(params=[*MJX_TASKS, *OTHERS])
def name(request):
    return request.param


# Complete episodes on MuJoCo C


# The slowest to compile: the largest observations.
LARGE = ("humanoid", "humanoid_standup", "humanoid-v5", "humanoid_standup-v5", "ant-v5")


@pytest.mark.parametrize("name", [pytest.param(t, marks=pytest.mark.slow) if t in LARGE else t for t in TASKS])
def test_complete_episodes_on_mujoco_are_gymnasiums(name):
    """Large and small actions; with small ones, more robots stay healthy for long."""
    found = compare_episodes(envs.make(name, "mujoco"), [record_episode(name, *case) for case in EPISODES])
    assert found.obs <= 1e-5 and found.reward <= 1e-5  # |error| <= 1e-5 + 1e-5 |x|
    assert found.terminations_agree
    assert found.steps >= 80  # the humanoid falls within 30, whatever it does


# One control step on MJX


def test_observation_of_a_given_state(name):
    np.testing.assert_allclose(ours(name)[0].obs, recorded(name).first_obs, rtol=1e-5, atol=2e-5)


def test_velocities_after_a_step(name):
    # the worst joint of each state; float32 can fall on the other side of a contact's edge, in one state of hundreds
    error = np.abs(ours(name)[1].final_obs[:, velocities(name)] - observed_velocity(name)).max(axis=1)
    assert np.median(error) <= 2e-5
    assert np.quantile(error, 0.95) <= 5e-4


def test_observation_after_a_step(name):
    obs, expected = np.asarray(ours(name)[1].final_obs), recorded(name).obs
    plain = obs.shape[1] - FORCES.get(name, 0)
    close = np.isclose(obs[:, :plain], expected[:, :plain], rtol=1e-4, atol=2e-3).all(axis=1)
    close &= np.isclose(obs[:, plain:], expected[:, plain:], rtol=5e-3, atol=0.2).all(axis=1)
    assert close.mean() >= 0.95
    assert np.median(np.abs(obs - expected)) < 1e-5


def test_reward(name):
    error = np.abs(ours(name)[1].reward - recorded(name).reward)
    assert np.median(error) <= 1e-5
    assert np.quantile(error, 0.95) <= 1e-4


def test_termination(name):
    np.testing.assert_array_equal(ours(name)[1].terminated, recorded(name).terminated)
    assert recorded(name).terminated.any() == (TASKS[name].healthy is not None)  # so that both answers are compared


def test_humanoid_contact_forces_are_compared():
    assert (np.abs(recorded("humanoid").obs[:, -84:]).max(axis=1) > 1).sum() >= 5


def test_time_limit_and_spaces(name):
    env = gymnasium_environment(name)
    assert env.observation_space.shape == ours(name)[0].obs.shape[1:]
    assert env.action_space.shape == recorded(name).action.shape[1:]
    assert gymnasium.spec(TASKS[name].gymnasium_id).max_episode_steps == environment(name).episode_length


def velocities(name: str) -> slice:
    positions = recorded(name).qpos.shape[1] - TASKS[name].unobserved
    return slice(positions, positions + recorded(name).qvel.shape[1])


def observed_velocity(name: str) -> np.ndarray:
    return np.clip(recorded(name).next_qvel, -TASKS[name].max_speed, TASKS[name].max_speed)
