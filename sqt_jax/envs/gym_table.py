"""The table of Gymnasium's locomotion tasks: their constants and their names.

Source: gymnasium/envs/mujoco/*_v4.py and *_v5.py, https://github.com/Farama-Foundation/Gymnasium.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax.numpy as jnp

from sqt_jax.envs.physics import QUANTITIES
from sqt_jax.types import Array

INF = float("inf")


class Task(NamedTuple):
    """One task. The reward of a step is `forward` × speed + `height` × z + `alive` - control cost - contact cost."""

    gymnasium_id: str
    xml: str  # a file among gymnasium's assets
    frame_skip: int
    ctrl_cost: float  # per squared unit of control
    noise: float  # scale of the random start
    normal_velocity: bool = False  # start velocities: normal, or uniform like the positions
    tracked: Callable[[Any, Any], Any] | None = None  # as in `Setup`: the point whose speed along x is rewarded
    unobserved: int = 1  # leading entries of qpos left out of the observation (x, or x and y)
    max_speed: float = INF  # observed velocities are clipped to it
    quantities: tuple[str, ...] = ()  # further fields that are observed, in this order
    # As in v4: the quantities' (constant) entries of the world body and the root's actuator forces are observed too.
    observes_world: bool = True
    forward: float = 1.0  # reward per m/s
    height: float = 0.0  # reward per m of z
    alive: float = 0.0  # reward per step
    alive_at_end: bool = True  # `alive` is also given for the step that terminates, as in v4
    contact_cost: float = 0.0  # per squared unit of external force
    force_limit: float = INF  # external forces are clipped to ± this, in observation and cost
    max_contact_cost: float = INF
    healthy: Callable[[Array, Array], Array] | None = None  # (qpos, qvel) -> bool; where false, the episode terminates
    # Options for the physics of that name, where its defaults do not suit the task.
    options: Mapping[str, Mapping[str, int]] = MappingProxyType({})


def _solver(iterations: int, ls_iterations: int = 3) -> Mapping[str, Mapping[str, int]]:
    """Options of MJX's solver: the fewest steps without a loss of accuracy (experiments/results/physics.md)."""
    return {"mjx": {"iterations": iterations, "ls_iterations": ls_iterations}}


def _torso(_: Any, data: Any) -> Any:
    return data.xpos[1, 0]


def _center_of_mass(model: Any, data: Any) -> Any:
    return (model.body_mass * data.xipos[:, 0]).sum() / model.body_mass.sum()


def _walker_healthy(qpos: Array, qvel: Array) -> Array:
    del qvel
    height, angle = qpos[1], qpos[2]
    return (height > 0.8) & (height < 2.0) & (angle > -1.0) & (angle < 1.0)


def _hopper_healthy(qpos: Array, qvel: Array) -> Array:
    rest = jnp.concatenate([qpos[2:], qvel])
    return (qpos[1] > 0.7) & (jnp.abs(qpos[2]) < 0.2) & jnp.all(jnp.abs(rest) < 100.0)


def _ant_healthy(qpos: Array, qvel: Array) -> Array:
    del qvel
    return (qpos[2] >= 0.2) & (qpos[2] <= 1.0)


def _humanoid_healthy(qpos: Array, qvel: Array) -> Array:
    del qvel
    return (qpos[2] > 1.0) & (qpos[2] < 2.0)


V4 = {
    "cheetah": Task(
        "HalfCheetah-v4", "half_cheetah.xml", 5, ctrl_cost=0.1, noise=0.1, normal_velocity=True,
        options=_solver(5),
    ),
    "walker": Task(
        "Walker2d-v4", "walker2d.xml", 4, ctrl_cost=1e-3, noise=5e-3,
        max_speed=10.0, alive=1.0, healthy=_walker_healthy, options=_solver(8),
    ),
    "ant": Task(
        "Ant-v4", "ant.xml", 5, ctrl_cost=0.5, noise=0.1, normal_velocity=True,
        tracked=_torso, unobserved=2, alive=1.0, healthy=_ant_healthy, options=_solver(7),
    ),
    "humanoid": Task(
        "Humanoid-v4", "humanoid.xml", 5, ctrl_cost=0.1, noise=1e-2,
        tracked=_center_of_mass, unobserved=2, quantities=QUANTITIES,
        forward=1.25, alive=5.0, healthy=_humanoid_healthy, options=_solver(6),
    ),
    "hopper": Task(
        "Hopper-v4", "hopper.xml", 4, ctrl_cost=1e-3, noise=5e-3,
        max_speed=10.0, alive=1.0, healthy=_hopper_healthy, options=_solver(5),
    ),
    "swimmer": Task(
        "Swimmer-v4", "swimmer.xml", 4, ctrl_cost=1e-4, noise=0.1, unobserved=2, options=_solver(4),
    ),
    # The height is divided by the physics' time step of 0.003 s.
    "humanoid_standup": Task(
        "HumanoidStandup-v4", "humanoidstandup.xml", 5, ctrl_cost=0.1, noise=1e-2,
        unobserved=2, quantities=QUANTITIES, forward=0.0, height=1 / 0.003, alive=1.0,
        contact_cost=5e-7, max_contact_cost=10.0,
        options=_solver(7),
    ),
}  # fmt: skip

# Where Gymnasium's v5 differs from v4.
V5: dict[str, dict[str, Any]] = {
    "cheetah": {},
    "walker": {"xml": "walker2d_v5.xml", "alive_at_end": False},
    "ant": {
        "alive_at_end": False, "quantities": ("cfrc_ext",), "observes_world": False,
        "contact_cost": 5e-4, "force_limit": 1.0,
    },
    "humanoid": {"alive_at_end": False, "observes_world": False, "contact_cost": 5e-7, "max_contact_cost": 10.0},
    "hopper": {"alive_at_end": False},
    "swimmer": {},
    "humanoid_standup": {"observes_world": False},
}  # fmt: skip


def _v5(name: str) -> Task:
    return V4[name]._replace(gymnasium_id=V4[name].gymnasium_id.replace("-v4", "-v5"), **V5[name])


TASKS: dict[str, Task] = V4 | {f"{name}-v5": _v5(name) for name in V4}

ALIASES = {
    "half_cheetah": "cheetah",
    "halfcheetah": "cheetah",
    "walker2d": "walker",
    "humanoidstandup": "humanoid_standup",
}


def versioned(name: str) -> str:
    """The name in `TASKS` of an alias or Gymnasium id (v4 has no suffix); of an unknown name, one not in `TASKS`."""
    base, dash, version = name.lower().partition("-v")
    base = ALIASES.get(base, base)
    return base if dash + version in ("", "-v4") else f"{base}-v{version}"
