"""MuJoCo Warp against MuJoCo C. Warp runs on a CPU too: all of this needs its package only."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("warp", reason="the extra `warp` is not installed")

from experiments.gymnasium_parity.trajectories import compare_steps  # noqa: E402
from sqt_jax import envs  # noqa: E402
from sqt_jax.envs import physics  # noqa: E402

pytestmark = pytest.mark.slow  # Warp compiles each kernel separately


@pytest.fixture(autouse=True)
def _on_any_device(monkeypatch):
    monkeypatch.setattr(physics, "LACKS", {})


@pytest.mark.parametrize("name", ["cheetah", "walker", "humanoid", "humanoid_standup-v5"])
def test_one_control_step_is_near_mujocos(name):
    found = compare_steps(name, envs.make(name, "warp"), 64)
    assert found.qvel_median <= 2e-5 and found.qvel_95 <= 5e-4
    assert found.obs_median <= 1e-4 and found.reward_median <= 1e-5
    assert found.terminations_agree == 1


def test_ants_median_step_is_near_mujocos():
    """Not its 95 %: Warp's frame of a steep capsule's contact is not MuJoCo's."""
    found = compare_steps("ant", envs.make("ant", "warp"), 64)
    assert found.qvel_median <= 2e-5 and found.terminations_agree == 1


def test_members_and_environments_are_one_batch_of_worlds():
    env = envs.make("cheetah", "warp")
    timesteps = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 6))
    actions = jax.random.uniform(jax.random.key(1), (6, 6), minval=-1)
    expected = jax.jit(jax.vmap(env.step))(timesteps, actions).final_obs
    grouped = jax.tree.map(lambda leaf: leaf.reshape(2, 3, *leaf.shape[1:]), (timesteps, actions))
    nested = jax.jit(jax.vmap(jax.vmap(env.step)))(*grouped).final_obs
    np.testing.assert_allclose(nested.reshape(6, -1), expected, rtol=1e-5, atol=1e-5)
    alone = jax.jit(env.step)(jax.tree.map(lambda leaf: leaf[2], timesteps), actions[2]).final_obs
    np.testing.assert_allclose(alone, expected[2], rtol=1e-5, atol=1e-5)


def test_a_diverged_robot_ends_its_episode_and_no_other():
    env = envs.make("cheetah", "warp")
    timesteps = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 3))
    qvel = timesteps.state.task.qvel.at[1, 2].set(jnp.nan)
    broken = jax.vmap(env.set_physics)(timesteps.state.task.qpos, qvel)
    after = jax.jit(jax.vmap(env.step))(broken, jnp.zeros((3, 6)))
    assert after.terminated.tolist() == [False, True, False]
    assert np.all(np.isfinite(after.obs)) and np.all(np.isfinite(after.reward))


def test_a_call_remembers_nothing_of_the_calls_before_it():
    """The simulator's data are kept between calls; a diverged robot is the worst that they can hold."""
    env = envs.make("cheetah", "warp")
    timesteps = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 3))
    actions = jax.random.uniform(jax.random.key(1), (3, 6), minval=-1)
    step = jax.jit(jax.vmap(env.step))
    first = step(timesteps, actions)
    step(first, -actions)
    step(jax.vmap(env.set_physics)(first.state.task.qpos, first.state.task.qvel.at[:, 2].set(jnp.nan)), actions)
    again = step(timesteps, actions)
    for one, other in zip(jax.tree.leaves(first.state.task), jax.tree.leaves(again.state.task), strict=True):
        np.testing.assert_array_equal(one, other)
