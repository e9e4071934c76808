"""Gymnasium's locomotion tasks (its v4 generation), written once over `Physics`.

Source: gymnasium/envs/mujoco/{half_cheetah,walker2d,ant,humanoid}_v4.py, https://github.com/Farama-Foundation/Gymnasium.
The models are the files in the installed gymnasium package. What differs: actions are in [-1, 1] and stretched to the
actuators' range, numbers are float32, and the time limit belongs to the environment (`autoreset`).
"""

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from sqt_jax.envs.autoreset import make_environment
from sqt_jax.envs.physics import Physics, PhysicsState, Setup, make_physics
from sqt_jax.types import Array, Environment

EPISODE_LENGTH = 1000  # Gymnasium's TimeLimit for all of them


class Task(NamedTuple):
    """One row of the table: what tells one locomotion task from another."""

    gymnasium_id: str
    xml: str  # a file among gymnasium's assets
    frame_skip: int
    ctrl_cost: float  # per squared unit of control
    noise: float  # scale of the random start
    normal_velocity: bool  # start velocities: normal with that scale, or uniform like the positions
    tracked: Callable[[Any, Any], Any] | None = None  # the point whose speed along x is rewarded, as in `Setup`
    hidden: int = 1  # leading entries of qpos left out of the observation (x, or x and y)
    max_speed: float = float("inf")  # observed velocities are clipped to it
    quantities: tuple[str, ...] = ()  # further fields that are observed, in this order
    forward: float = 1.0  # reward per m/s
    alive: float = 0.0  # reward per step, also for the one that terminates
    healthy: Callable[[Array], Array] | None = None  # qpos -> bool; where false, the episode terminates


def _torso(_: Any, data: Any) -> Any:
    return data.xpos[1, 0]


def _center_of_mass(model: Any, data: Any) -> Any:
    return (model.body_mass * data.xipos[:, 0]).sum() / model.body_mass.sum()


def _walker_healthy(qpos: Array) -> Array:
    height, angle = qpos[1], qpos[2]
    return (height > 0.8) & (height < 2.0) & (angle > -1.0) & (angle < 1.0)


def _ant_healthy(qpos: Array) -> Array:
    return (qpos[2] >= 0.2) & (qpos[2] <= 1.0)


def _humanoid_healthy(qpos: Array) -> Array:
    return (qpos[2] > 1.0) & (qpos[2] < 2.0)


TASKS: dict[str, Task] = {
    "cheetah": Task(
        "HalfCheetah-v4", "half_cheetah.xml", 5, ctrl_cost=0.1, noise=0.1, normal_velocity=True
    ),
    "walker": Task(
        "Walker2d-v4", "walker2d.xml", 4, ctrl_cost=1e-3, noise=5e-3, normal_velocity=False,
        max_speed=10.0, alive=1.0, healthy=_walker_healthy,
    ),
    "ant": Task(
        "Ant-v4", "ant.xml", 5, ctrl_cost=0.5, noise=0.1, normal_velocity=True,
        tracked=_torso, hidden=2, alive=1.0, healthy=_ant_healthy,
    ),
    "humanoid": Task(
        "Humanoid-v4", "humanoid.xml", 5, ctrl_cost=0.1, noise=1e-2, normal_velocity=False,
        tracked=_center_of_mass, hidden=2, quantities=("cinert", "cvel", "qfrc_actuator", "cfrc_ext"),
        forward=1.25, alive=5.0, healthy=_humanoid_healthy,
    ),
}  # fmt: skip

ALIASES = {"half_cheetah": "cheetah", "halfcheetah": "cheetah", "walker2d": "walker"}


def observe(task: Task, state: PhysicsState) -> Array:
    """The observation `[O]` of a physical state."""
    velocity = jnp.clip(state.qvel, -task.max_speed, task.max_speed)
    return jnp.concatenate([state.qpos[task.hidden :], velocity, *(state.quantities[q] for q in task.quantities)])


def reward(task: Task, state: PhysicsState, control: Array, control_step: float) -> Array:
    """The reward `[]` of the control step of `control_step` seconds that led to `state`."""
    speed = state.displacement / control_step
    return task.forward * speed + task.alive - task.ctrl_cost * jnp.sum(jnp.square(control))


def draw_start(task: Task, qpos0: np.ndarray, num_velocities: int, key: Array) -> tuple[Array, Array]:
    """Positions and velocities of a random start: the model's rest pose with noise."""
    position_key, velocity_key = jax.random.split(key)
    draw = jax.random.normal if task.normal_velocity else partial(jax.random.uniform, minval=-1.0, maxval=1.0)
    noise = jax.random.uniform(position_key, qpos0.shape, jnp.float32, -task.noise, task.noise)
    return jnp.asarray(qpos0, jnp.float32) + noise, task.noise * draw(velocity_key, (num_velocities,), jnp.float32)


def load_model(task: Task) -> mujoco.MjModel:
    """The task's model, from the installed gymnasium package.

    Raises:
      FileNotFoundError: gymnasium is not installed.
    """
    # found without importing gymnasium.envs.mujoco, which wants packages for rendering
    spec = find_spec("gymnasium")
    if spec is None or spec.origin is None:
        raise FileNotFoundError("the models of the locomotion tasks are in the package gymnasium: not installed")
    path = Path(spec.origin).parent / "envs" / "mujoco" / "assets" / task.xml
    # the cheetah's file uses a deprecated attribute; MuJoCo would write so into a log file in the current directory
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    finally:
        mujoco.set_mju_user_warning(None)


def make_task(name: str, physics: str = "mjx", **options: Any) -> Environment:
    """The environment of the row `name` in `TASKS`, on the named simulator with its options.

    Raises:
      ValueError: the simulator is unknown.
      TypeError: it has no such option.
    """
    task = TASKS[name]
    model = load_model(task)
    simulator: Physics = make_physics(physics, Setup(model, task.frame_skip, task.quantities, task.tracked), **options)
    low, high = model.actuator_ctrlrange.T.astype(np.float32)
    control_step = model.opt.timestep * task.frame_skip

    def place(qpos: Array, qvel: Array) -> tuple[PhysicsState, Array]:
        state = simulator.place(qpos, qvel)
        return state, observe(task, state)

    def start(key: Array) -> tuple[PhysicsState, Array]:
        return place(*draw_start(task, model.qpos0, model.nv, key))

    def advance(state: PhysicsState, action: Array) -> tuple[PhysicsState, Array, Array, Array]:
        control = (low + high) / 2 + action * ((high - low) / 2)
        state = simulator.advance(state, control)
        terminated = jnp.zeros((), bool) if task.healthy is None else ~task.healthy(state.qpos)
        return state, observe(task, state), reward(task, state, control, control_step), terminated

    observation_size = jax.eval_shape(start, jax.random.key(0))[1].size
    return make_environment(name, observation_size, model.nu, EPISODE_LENGTH, start, advance, place)
