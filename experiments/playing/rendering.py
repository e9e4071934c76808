"""Off-screen pictures of a MuJoCo model in given configurations.

MuJoCo chooses OpenGL's implementation when it is imported: set MUJOCO_GL before (`graphics.choose`).
"""

import copy
from collections.abc import Iterable, Iterator, Sequence

import mujoco
import numpy as np

TRACKING = "track"  # the camera that follows the robot, in the models of Gymnasium's locomotion tasks

DISTANCE, ELEVATION = 4.0, -20.0  # m and degrees of our own camera, the same as Gymnasium's
SHADOW_TEXELS = 1024  # as fine as the pictures; MuJoCo's 4096 double the time of software rendering


def cameras(model: mujoco.MjModel) -> list[str]:
    """The names of a model's cameras."""
    return [name for i in range(model.ncam) if (name := model.camera(i).name)]


def frames(
    model: mujoco.MjModel, configurations: Iterable[np.ndarray], size: Sequence[int] = (640, 480), camera: str = ""
) -> Iterator[np.ndarray]:
    """One picture [height, width, 3] uint8 per configuration; each is a new array.

    Args:
      configurations: as in `place`.
      size: width and height in pixels.
      camera: the name of one of the model's `cameras`; empty: `TRACKING`, or a free one that follows the robot.

    Raises:
      ValueError: the model has no such camera.
    """
    view = view_of(model, camera)
    width, height = size
    model = copy.copy(model)
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height  # MuJoCo draws nothing larger
    model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, SHADOW_TEXELS)
    data = mujoco.MjData(model)
    with mujoco.Renderer(model, height, width) as renderer:
        for configuration in configurations:
            place(model, data, configuration)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, view)
            yield renderer.render().copy()


def place(model: mujoco.MjModel, data: mujoco.MjData, configuration: np.ndarray) -> None:
    """Sets qpos [nq], and the bodies that a task moves itself (mocap), such as a target: [nq] or [nq + 7 nmocap].

    After qpos come the positions of all these bodies, then their quaternions.
    """
    parts = mujoco.mjtState.mjSTATE_QPOS
    if len(configuration) > model.nq:
        parts |= mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT
    mujoco.mj_setState(model, data, np.asarray(configuration, np.float64), parts)


def view_of(model: mujoco.MjModel, camera: str = "") -> mujoco.MjvCamera:
    """MuJoCo's description of the camera with this name, as in `frames`.

    Raises:
      ValueError: the model has no such camera.
    """
    names = cameras(model)
    view = mujoco.MjvCamera()
    if camera and camera not in names:
        raise ValueError(f"expects one of {', '.join(names) or 'no names: the model has no cameras'}, not {camera!r}")
    if camera or TRACKING in names:
        view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        view.fixedcamid = model.camera(camera or TRACKING).id
        return view
    return following(model, view)


def following(model: mujoco.MjModel, view: mujoco.MjvCamera) -> mujoco.MjvCamera:
    """Changes `view` to a camera that follows the robot and can be turned by hand; returns it."""
    mujoco.mjv_defaultFreeCamera(model, view)  # its distance is the width of the floor
    view.type = mujoco.mjtCamera.mjCAMERA_TRACKING
    view.trackbodyid = min(1, model.nbody - 1)
    view.distance, view.elevation = DISTANCE, ELEVATION
    return view
