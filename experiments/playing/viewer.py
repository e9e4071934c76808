"""MuJoCo's viewer, playing episodes in real time until its window is closed."""

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np

from experiments.playing import rendering

CLOSING_SECONDS = 10.0


def show(
    model: mujoco.MjModel,
    episodes: Sequence[tuple[np.ndarray, np.ndarray]],
    period: float,
    camera: str = "",
    launch: Callable[..., Any] | None = None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Shows episodes one after another, in a loop, until the user closes the window.

    Args:
      episodes: of each, T configurations as in `rendering.place`, and qvel [T, nv].
      period: seconds between two states.
      camera: the name of one of the model's cameras; empty: one that follows the robot and can be turned by hand.
      launch: opens the window; None is `mujoco.viewer.launch_passive`.
      clock: seconds.
      sleep: waits for a number of seconds.

    Raises:
      RuntimeError: a window cannot be opened (on macOS: python was not started as `mjpython`).
      ValueError: the model has no such camera.
    """
    if launch is None:
        from mujoco import viewer  # only here: it loads GLFW

        launch = viewer.launch_passive
    view = rendering.view_of(model, camera) if camera else rendering.following(model, mujoco.MjvCamera())
    others = set(threading.enumerate())
    try:
        with launch(model, mujoco.MjData(model), show_left_ui=False, show_right_ui=False) as window:
            _run(window, view, episodes, period, clock, sleep)
    finally:
        # The window closes in a thread of its own, which must have ended before the process does.
        for thread in set(threading.enumerate()) - others:
            thread.join(CLOSING_SECONDS)


def _run(
    window: Any,
    view: mujoco.MjvCamera,
    episodes: Sequence[tuple[np.ndarray, np.ndarray]],
    period: float,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> None:
    model, data = window.m, window.d
    with window.lock():
        for name in ("type", "fixedcamid", "trackbodyid", "distance", "azimuth", "elevation"):
            setattr(window.cam, name, getattr(view, name))
    due = clock()
    while window.is_running():
        for configuration, qvel in (state for episode in episodes for state in zip(*episode, strict=True)):
            with window.lock():
                rendering.place(model, data, configuration)
                data.qvel[:] = qvel
                mujoco.mj_forward(model, data)
            window.sync()
            due += period
            sleep(max(0.0, due - clock()))
            if not window.is_running():
                return
