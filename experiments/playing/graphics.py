"""The OpenGL implementation that MuJoCo renders with. Does not import MuJoCo, which reads MUJOCO_GL when imported."""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping

OFF_SCREEN = ("egl", "osmesa")  # need no display; the faster one first
PROBE_SECONDS = 60

# Draws a sphere in front of the camera: a context that opens may still draw nothing.
PROBE = """
import mujoco
ball = "<mujoco><worldbody><light pos='0 0 3'/><geom size='1' rgba='1 1 1 1'/></worldbody></mujoco>"
model = mujoco.MjModel.from_xml_string(ball)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 16, 16) as renderer:
    renderer.update_scene(data)
    assert renderer.render().any()
"""


class NoGraphics(Exception):
    """No OpenGL implementation works; the text says what to install."""


def works(name: str) -> bool:
    """Whether MuJoCo can render with `MUJOCO_GL=name` (empty: its own choice).

    Tried in a process of its own: a failed attempt can crash a process, or break later attempts in it.
    """
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    environment |= {"MUJOCO_GL": name} if name else {}
    try:
        done = subprocess.run(
            [sys.executable, "-c", PROBE], env=environment, capture_output=True, timeout=PROBE_SECONDS, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def has_display(environment: Mapping[str, str] = os.environ, platform: str = sys.platform) -> bool:
    """Whether a window may open: with X11 or Wayland on Linux, always on other systems."""
    return not platform.startswith("linux") or any(environment.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def choose(
    environment: Mapping[str, str] = os.environ, platform: str = sys.platform, works: Callable[[str], bool] = works
) -> str:
    """A value for MUJOCO_GL that works; empty if MuJoCo's own choice works. A value set by the user is kept.

    Raises:
      NoGraphics: none works.
    """
    if named := environment.get("MUJOCO_GL", "").strip():
        if works(named):
            return named
        raise NoGraphics(f"MUJOCO_GL={named} cannot render here; unset it, or {_advice(platform)}")
    if platform.startswith("linux"):
        candidates: tuple[str, ...] = ("glfw", *OFF_SCREEN) if has_display(environment, platform) else OFF_SCREEN
    else:
        candidates = ("",)
    for name in candidates:
        if works(name):
            return name
    tried = ", ".join(filter(None, candidates)) or "MuJoCo's own"
    raise NoGraphics(f"no OpenGL works here for rendering (tried: {tried}); {_advice(platform)}")


def _advice(platform: str) -> str:
    if platform.startswith("linux"):
        return "apt-get install libosmesa6 (or libegl1, for a GPU with its driver) installs one"
    return "rendering needs a graphical session"
