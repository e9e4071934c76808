"""Environments of Gymnasium and of other packages (`pip install -e '.[tasks]'`), as a user names them."""

import json
from importlib.util import find_spec
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import run
from sqt_jax import envs
from sqt_jax.envs.gym_ids import from_gymnasium

TINY = ["--algo=sac_sqt", "--seeds=0,1", "--steps=100", "--warmup_steps=50", "--eval_every=100", "--eval_episodes=1"]
TINY += ["--hidden=8", "--batch_size=8", "--notensorboard", "--quiet", "--name=a"]
# id, arguments, the package it needs, sizes of observation and action
TASKS = [
    ("gym:Pendulum-v1", ["--env_args=g=9.81"], "gymnasium", (3, 1)),
    ("gym:BipedalWalker-v3", ["--max_episode_steps=60"], "Box2D", (24, 4)),
    ("gym:LunarLander-v3", ["--env_args=continuous=true", "--max_episode_steps=60"], "Box2D", (8, 2)),
    ("gym:gymnasium_robotics:PointMaze_UMaze-v3", [], "gymnasium_robotics", (8, 2)),  # a goal: Dict observations
    ("gym:shimmy:dm_control/cheetah-run-v0", ["--max_episode_steps=60"], "shimmy", (17, 6)),
]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of the packages
@pytest.mark.parametrize(("name", "arguments", "package", "sizes"), TASKS, ids=[task[0] for task in TASKS])
def test_a_task_of_another_package_is_trained_on(tmp_path, monkeypatch, name, arguments, package, sizes):
    if find_spec(package) is None:
        pytest.skip(f"the package {package} is not installed: pip install -e '.[tasks]'")
    monkeypatch.chdir(tmp_path)
    assert run.main(["run", *TINY, f"--env={name}", *arguments]) == 0
    (folder,) = Path("runs").glob("*/sac_sqt/a")
    content = json.loads((folder / "policy/config.json").read_text())
    assert (content["observation_size"], content["action_size"]) == sizes


@pytest.mark.filterwarnings("ignore:.*out of date", "ignore:.*deprecated")
def test_half_cheetah_on_the_host_is_the_cheetah_on_mujoco():
    """The same start and actions: the same observations and rewards, to float32."""
    made = []

    def make():
        made.append(gymnasium.make("HalfCheetah-v4"))
        return made[-1]

    theirs, ours = from_gymnasium("cheetah", make), envs.make("cheetah", "mujoco")
    timestep = theirs.reset(jax.random.key(0))
    playing = made[-1].unwrapped
    position, velocity = np.float32(playing.data.qpos), np.float32(playing.data.qvel)
    playing.set_state(position.astype(float), velocity.astype(float))
    other = ours.set_physics(jnp.asarray(position), jnp.asarray(velocity))
    step, other_step = jax.jit(theirs.step), jax.jit(ours.step)
    total = other_total = 0.0
    for key in jax.random.split(jax.random.key(1), 300):
        action = jax.random.uniform(key, (6,), minval=-1.0, maxval=1.0)
        timestep, other = step(timestep, action), other_step(other, action)
        total, other_total = total + float(timestep.reward), other_total + float(other.reward)
        np.testing.assert_allclose(timestep.obs, other.obs, rtol=1e-5, atol=1e-5)
    assert theirs.host.error() is None and abs(total - other_total) < 1e-3 < abs(total)
