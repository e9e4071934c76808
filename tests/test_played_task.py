"""The environment to play in: the run's task, on the physics that the flags name."""

import mujoco
import pytest

from experiments.commandline.arguments import UsageError
from experiments.playing.played_task import make_played_task
from sqt_jax.envs import physics
from sqt_jax.experiment import make_config

HOPPER = make_config("td3", "hopper")


def test_a_task_is_played_on_mujoco_by_default():
    task = make_played_task(HOPPER, None, "")
    assert (task.env.name, task.physics) == ("hopper", "mujoco") and task.period == pytest.approx(0.008)
    assert isinstance(task.scene, mujoco.MjModel)
    assert make_played_task(HOPPER, "mjx", "track").physics == "mjx"


def test_an_environment_with_jax_that_was_trained_in_processes_is_played():
    task = make_played_task(make_config("td3", "gym:phys2d/Pendulum-v0"), None, "")
    assert task.env.episode_length == 200 and task.env.host


@pytest.mark.parametrize(
    ("asked", "camera", "says"),
    [
        ("spring", "", "--physics=spring: expects one of mjx, mujoco, warp"),
        ("warp", "", "--physics=warp: needs a part"),
        (None, "side", "--camera=side: expects one of track"),
    ],
)
def test_other_physics_and_cameras_are_rejected(asked, camera, says, monkeypatch):
    monkeypatch.setitem(physics.LACKS, "warp", lambda: "a part")
    with pytest.raises(UsageError, match=says):
        make_played_task(HOPPER, asked, camera)
