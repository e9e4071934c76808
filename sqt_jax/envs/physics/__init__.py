"""The small interface through which the tasks see a simulator, and the table of simulators.

A task is written once over `Physics`; which simulator computes it is a name in `PHYSICS`.
"""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import jax

from sqt_jax.names import unknown
from sqt_jax.types import Array, State


class PhysicsState(NamedTuple):
    """The state of one simulated robot, and what observations and rewards may need of it.

    `quantities` are MuJoCo's fields of that name, flattened, with MuJoCo's timing: after a step they are those of the
    last evaluation inside it (`mj_step`, then `mj_rnePostConstraint`), after `place` those of the given state with
    no force acting.
    """

    qpos: Array  # [nq] float32: m, rad, unit quaternions
    qvel: Array  # [nv] float32: m/s, rad/s
    displacement: Array  # [] float32: way of the tracked point along x in the last control step, m
    quantities: dict[str, Array]  # the fields in `Setup.quantities`, each flat
    internal: State  # the simulator's own, such as the solver's warm start


class Setup(NamedTuple):
    """What a task asks of a simulator."""

    model: Any  # a mujoco.MjModel
    frame_skip: int  # simulator steps in one control step
    quantities: tuple[str, ...] = ()  # out of QUANTITIES
    # (model, data) -> x of the point whose displacement is measured, m, from MuJoCo's structs or from MJX's, with the
    # timing of the quantities; None: qpos[0], as it is after the step
    tracked: Callable[[Any, Any], Any] | None = None


class Physics(NamedTuple):
    """A simulator of one model, as pure functions of one robot; `vmap` gives many."""

    place: Callable[[Array, Array], PhysicsState]  # (qpos [nq], qvel [nv]) -> state at rest of forces
    advance: Callable[[PhysicsState, Array], PhysicsState]  # (state, control [nu]) -> state one control step later


# fields of mjData that a task may ask for, in the order in which the humanoids observe them
QUANTITIES = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")

# name -> module with `make(setup, **options) -> Physics`, imported when first asked for
PHYSICS = {
    "mjx": "sqt_jax.envs.physics.mjx",
    "mujoco": "sqt_jax.envs.physics.mujoco_c",
    "warp": "sqt_jax.envs.physics.mjx_warp",
}


def _warp_lacks() -> str:
    if find_spec("warp") is None:
        return "the package warp-lang (pip install -e '.[warp]')"
    device = jax.devices()[0]
    # a GPU of another maker is a "gpu" too
    if device.platform != "gpu" or "cuda" not in device.client.platform_version.lower():
        return f"an NVIDIA GPU as JAX's device, which is {device.platform}"
    return ""


# What a simulator needs and this machine has not, in words; asked when it is wanted, since it starts JAX.
LACKS = {"warp": _warp_lacks}


def lacks(name: str) -> str:
    """What is missing here to run a simulator; empty where nothing is."""
    return LACKS[name]() if name in LACKS else ""


def make_physics(name: str, setup: Setup, **options: Any) -> Physics:
    """Make the simulator called `name`.

    Raises:
      ValueError: the name is unknown, or the simulator cannot run here.
      TypeError: the simulator has no such option.
    """
    if name not in PHYSICS:
        raise ValueError("physics " + unknown(name, PHYSICS))
    if missing := lacks(name):
        raise ValueError(f"physics {name} needs {missing}")
    return import_module(PHYSICS[name]).make(setup, **options)
