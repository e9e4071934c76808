"""Which OpenGL is chosen, and the error if there is none."""

import os
import subprocess
import sys

import pytest

from experiments.playing import graphics
from experiments.playing.graphics import NoGraphics, choose, has_display

DISPLAY = {"DISPLAY": ":0"}


@pytest.mark.parametrize(
    ("environment", "platform", "working", "chosen", "asked"),
    [
        ({}, "linux", {"egl", "osmesa"}, "egl", ["egl"]),
        ({}, "linux", {"osmesa", "glfw"}, "osmesa", ["egl", "osmesa"]),
        (DISPLAY, "linux", {"glfw", "egl"}, "glfw", ["glfw"]),
        ({"WAYLAND_DISPLAY": "wayland-0"}, "linux", {"osmesa"}, "osmesa", ["glfw", "egl", "osmesa"]),
        ({"MUJOCO_GL": "osmesa"}, "linux", {"egl", "osmesa"}, "osmesa", ["osmesa"]),
        (DISPLAY | {"MUJOCO_GL": " egl "}, "linux", {"egl"}, "egl", ["egl"]),
        ({"MUJOCO_GL": ""}, "linux", {"egl"}, "egl", ["egl"]),
        ({}, "darwin", {""}, "", [""]),
    ],
)
def test_the_first_implementation_that_works_is_chosen(environment, platform, working, chosen, asked):
    tried = []
    assert choose(environment, platform, lambda name: tried.append(name) or name in working) == chosen
    assert tried == asked


@pytest.mark.parametrize(
    ("environment", "platform", "says"),
    [
        (
            {},
            "linux",
            "no OpenGL works here for rendering (tried: egl, osmesa); apt-get install libosmesa6 (or libegl1",
        ),
        (DISPLAY, "linux", "(tried: glfw, egl, osmesa); apt-get install libosmesa6"),
        ({"MUJOCO_GL": "egl"}, "linux", "MUJOCO_GL=egl cannot render here; unset it, or apt-get install libosmesa6"),
        ({}, "darwin", "(tried: MuJoCo's own); rendering needs a graphical session"),
    ],
)
def test_the_error_says_what_to_install(environment, platform, says):
    with pytest.raises(NoGraphics) as error:
        choose(environment, platform, lambda name: False)
    assert says in str(error.value) and str(error.value).isprintable()


def test_displays():
    assert has_display(DISPLAY, "linux") and has_display({}, "darwin")
    assert not has_display({}, "linux") and not has_display({"DISPLAY": ""}, "linux")


def test_an_attempt_that_fails_or_hangs_counts_as_failed(monkeypatch):
    before = dict(os.environ)
    assert not graphics.works("nonsense")
    assert dict(os.environ) == before
    monkeypatch.setattr(graphics, "PROBE", "import os; os.abort()")
    assert not graphics.works("egl")
    monkeypatch.setattr(graphics, "PROBE", "import os; assert os.environ['MUJOCO_GL'] == 'egl'")
    assert graphics.works("egl")
    monkeypatch.setattr(graphics, "PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(graphics, "PROBE_SECONDS", 0.2)
    assert not graphics.works("egl")


def test_mujoco_is_not_imported_before_the_choice():
    code = "import sys; from experiments import play; assert not {'mujoco', 'jax', 'PIL'} & {*sys.modules}"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
