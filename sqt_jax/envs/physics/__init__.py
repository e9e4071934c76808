"""The interface between tasks and the physics that simulate them, and the table of physics.

A task is written once for the interface `Physics`; `PHYSICS` has its implementations by name.
"""

from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import jax

from sqt_jax.suggestions import expects_one_of
from sqt_jax.types import Array, State


class PhysicsState(NamedTuple):
    """The state of one simulated robot, and the quantities that observations and rewards need.

    `quantities` are fields of MuJoCo's `mjData`, flattened. Their timing is MuJoCo's: after a step they are those of
    the last evaluation inside it (`mj_step`, then `mj_rnePostConstraint`), after `place` those of the given state
    without forces.
    """

    qpos: Array  # [nq] float32: m, rad, unit quaternions
    qvel: Array  # [nv] float32: m/s, rad/s
    displacement: Array  # [] float32, m: displacement of the tracked point along x in the last control step
    quantities: dict[str, Array]  # the fields in `Setup.quantities`, each flat
    internal: State  # the implementation's own, for example the solver's warm start


class Setup(NamedTuple):
    """The requirements of a task on its physics."""

    model: Any  # a mujoco.MjModel
    frame_skip: int  # physics steps in one control step
    quantities: tuple[str, ...] = ()  # out of QUANTITIES
    # (model, data) -> x in m of the point whose displacement is measured, from MuJoCo's structs or MJX's, with the
    # timing of the quantities. None: qpos[0] after the step.
    tracked: Callable[[Any, Any], Any] | None = None


class Physics(NamedTuple):
    """The physics of one model, as pure functions of one robot; `vmap` gives many."""

    place: Callable[[Array, Array], PhysicsState]  # (qpos [nq], qvel [nv]) -> that state, without forces
    advance: Callable[[PhysicsState, Array], PhysicsState]  # (state, control [nu]) -> state one control step later


# Fields of mjData that a task may need, in the order in which the humanoids observe them.
QUANTITIES = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")

# name -> module with `make(setup, **options) -> Physics`, imported on first use
PHYSICS = {
    "mjx": "sqt_jax.envs.physics.mjx",
    "mujoco": "sqt_jax.envs.physics.mujoco_c",
    "warp": "sqt_jax.envs.physics.mujoco_warp",
}


def _warp_lacks() -> str:
    if find_spec("warp") is None:
        return "the package warp-lang (pip install -e '.[warp]')"
    device = jax.devices()[0]
    with suppress(RuntimeError):  # there is no CUDA
        if device in jax.devices("cuda"):  # its platform is "gpu", and so is that of an AMD GPU
            return ""
    return f"an NVIDIA GPU as JAX's device, which is {device.platform}"


# Physics with requirements: name -> a function that returns what this machine lacks, "" if nothing. It may start JAX.
LACKS = {"warp": _warp_lacks}


def lacks(name: str) -> str:
    """What this machine lacks to run the physics `name`, in words; "" if nothing. May start JAX."""
    return LACKS[name]() if name in LACKS else ""


def make_physics(name: str, setup: Setup, **options: Any) -> Physics:
    """Make the physics called `name`, with its options.

    Raises:
      ValueError: the name is unknown, or this machine lacks something the physics needs (`lacks`).
      TypeError: the physics has no such option.
    """
    if name not in PHYSICS:
        raise ValueError("physics: " + expects_one_of(name, PHYSICS))
    if missing := lacks(name):
        raise ValueError(f"physics {name} needs {missing}")
    return import_module(PHYSICS[name]).make(setup, **options)
