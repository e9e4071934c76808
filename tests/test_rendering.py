"""Pictures of the tasks: the robot in view, upright, on its ground. Drawn in a process with an OpenGL that works."""

import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from experiments.playing import graphics, rendering
from sqt_jax.envs.gym_table import TASKS
from sqt_jax.envs.gym_tasks import load_model

WIDTH, HEIGHT = 96, 64
# Of each model: at rest, the same again, far along x; and at rest without its robot.
DRAW = """
import sys
import mujoco, numpy as np
from experiments.playing import rendering
drawn = {}
for path in sys.argv[2:]:
    model = mujoco.MjModel.from_binary_path(path)
    far = model.qpos0.copy()
    far[0] += 30
    places = [model.qpos0, model.qpos0, far]
    pictures = list(rendering.frames(model, places, (96, 64)))
    model.geom_rgba[model.geom_bodyid > 0, 3] = 0
    pictures += rendering.frames(model, places[:1], (96, 64))
    drawn[path] = np.stack(pictures)
np.savez(sys.argv[1], *drawn.values())
"""
NAMES = ("cheetah", "humanoid")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    try:
        name = graphics.choose()
    except graphics.NoGraphics as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("drawn")
    paths = [str(folder / f"{task}.mjb") for task in NAMES]
    for task, path in zip(NAMES, paths, strict=True):
        mujoco.mj_saveModel(load_model(TASKS[task]), path)
    command = [sys.executable, "-c", DRAW, str(folder / "drawn.npz"), *paths]
    subprocess.run(command, check=True, timeout=120, env=os.environ | {"MUJOCO_GL": name})
    with np.load(folder / "drawn.npz") as file:
        return dict(zip(NAMES, (file[key].astype(int) for key in file.files), strict=True))


@pytest.mark.parametrize("task", NAMES)
def test_the_robot_is_in_view_and_its_ground_below(drawn, task):
    rest, again, far, without = drawn[task]
    assert rest.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_array_equal(rest, again)
    robot = abs(rest - without).max(axis=2) > 30  # with its shadow and its mirror image
    rows, columns = np.nonzero(robot)
    assert robot.sum() > 50
    assert abs(columns.mean() - WIDTH / 2) < WIDTH / 8 and abs(rows.mean() - HEIGHT / 2) < HEIGHT / 4
    # the camera follows it: 30 m further it is still in view
    there = abs(far - without).max(axis=2) > 30
    assert abs(np.nonzero(there[:, 10:-10])[1].mean() + 10 - WIDTH / 2) < WIDTH / 4
    # chequered below, the plain sky above
    assert without[-HEIGHT // 4 :].std(axis=1).mean() > 30
    assert without[: HEIGHT // 4].std(axis=1).mean() < 5


def test_the_default_camera_follows_the_robot():
    for task in TASKS.values():
        model = load_model(task)
        view = rendering.view_of(model)
        assert view.type == mujoco.mjtCamera.mjCAMERA_FIXED
        assert model.camera(view.fixedcamid).name == "track" and "track" in rendering.cameras(model)


def test_a_robot_without_a_tracking_camera_is_followed_too():
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body><geom size='1'/></body></worldbody></mujoco>")
    view = rendering.view_of(model)
    assert (view.type, view.trackbodyid) == (mujoco.mjtCamera.mjCAMERA_TRACKING, 1)
    with pytest.raises(ValueError, match="the model has no cameras, not 'side'"):
        rendering.view_of(model, "side")


def test_a_camera_that_the_model_does_not_have_is_rejected():
    model = load_model(TASKS["ant"])
    with pytest.raises(ValueError, match="expects one of track, not 'side'"):
        next(rendering.frames(model, [model.qpos0], camera="side"))


def test_bodies_that_a_task_moves_itself_are_placed_after_the_joints():
    xml = "<body mocap='true'><geom size='1'/></body><body><joint type='slide'/><geom size='1'/></body>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{xml}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    rendering.place(model, data, np.float32([0.5, 1, 2, 3, 0, 1, 0, 0]))
    assert data.qpos == [0.5]
    np.testing.assert_array_equal(data.mocap_pos, [[1, 2, 3]])
    np.testing.assert_array_equal(data.mocap_quat, [[0, 1, 0, 0]])
    rendering.place(model, data, np.float32([0.25]))
    assert data.qpos == [0.25] and data.mocap_pos[0, 0] == 1
