"""MuJoCo's viewer shows the states in order, in real time, until its window is closed. The window is a fake."""

import threading
import time
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from experiments.playing import viewer
from sqt_jax.envs.gym_table import TASKS
from sqt_jax.envs.gym_tasks import load_model

MODEL = load_model(TASKS["hopper"])


class Window:
    """A window that its user closes after some pictures."""

    def __init__(self, pictures):
        self.left, self.shown, self.closed = pictures, [], False
        self.cam, self.close_requested = mujoco.MjvCamera(), threading.Event()

    @contextmanager
    def launch(self, model, data, show_left_ui, show_right_ui):
        self.m, self.d = model, data
        thread = threading.Thread(target=self._draw)
        thread.start()
        try:
            yield self
        finally:
            self.close_requested.set()

    def _draw(self):
        self.close_requested.wait(10)
        time.sleep(0.1)  # closing takes a while
        self.closed = True

    def is_running(self):
        return self.left > 0

    def sync(self):
        self.left -= 1
        self.shown.append((self.d.qpos[0], self.d.qvel[0], self.d.xpos[1, 0]))

    def lock(self):
        return nullcontext()


def states(numbers):
    qpos = np.tile(MODEL.qpos0, (len(numbers), 1))
    qvel = np.zeros((len(numbers), MODEL.nv))
    qpos[:, 0] = qvel[:, 0] = numbers
    return qpos, qvel


def test_episodes_are_shown_in_order_until_the_window_is_closed():
    window, now, slept = Window(pictures=8), SimpleNamespace(time=0.0), []

    def sleep(seconds):
        slept.append(round(seconds, 6))
        now.time += seconds

    def clock():
        now.time += 0.002  # the time to draw
        return now.time

    episodes = [states([1, 2, 3]), states([11, 12])]
    viewer.show(MODEL, episodes, 0.008, launch=window.launch, clock=clock, sleep=sleep)
    assert [row[0] for row in window.shown] == [1, 2, 3, 11, 12, 1, 2, 3]
    assert all(position == speed == body for position, speed, body in window.shown)
    assert slept == [0.006] * 8 and window.closed
    assert (window.cam.type, window.cam.trackbodyid) == (mujoco.mjtCamera.mjCAMERA_TRACKING, 1)


def test_a_camera_can_be_named():
    window = Window(pictures=1)
    viewer.show(MODEL, [states([1])], 0.008, "track", launch=window.launch, sleep=lambda seconds: None)
    assert (window.cam.type, window.cam.fixedcamid) == (mujoco.mjtCamera.mjCAMERA_FIXED, MODEL.camera("track").id)
    with pytest.raises(ValueError, match="expects one of track"):
        viewer.show(MODEL, [states([1])], 0.008, "side", launch=window.launch)


def test_the_window_is_closed_before_an_interrupt_continues():
    window = Window(pictures=5)

    def interrupted(seconds):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        viewer.show(MODEL, [states([1])], 0.008, launch=window.launch, sleep=interrupted)
    assert window.closed
