"""Gymnasium's locomotion tasks on any `Physics`: starts, observations, rewards, termination.

The models are the XML files of the installed gymnasium package. Differences from Gymnasium: actions are in [-1, 1] and
scaled to the actuators' range, numbers are float32, and the time limit is part of the environment (`autoreset`).
"""

from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from sqt_jax.envs.autoreset import MIN_STEPS_TO_FALL, make_environment
from sqt_jax.envs.gym_table import TASKS, Task
from sqt_jax.envs.physics import Physics, PhysicsState, Setup, make_physics
from sqt_jax.types import Array, Environment

EPISODE_LENGTH = 1000  # Gymnasium's TimeLimit for all of them


# Leading entries of the quantities that belong to the world body, or to the root joint (qfrc_actuator).
WORLD_ENTRIES = {"cinert": 10, "cvel": 6, "qfrc_actuator": 6, "cfrc_ext": 6}


def forces(task: Task, state: PhysicsState) -> Array:
    """External forces and torques on all bodies, clipped to the task's limit: [6 × bodies], N and Nm."""
    return jnp.clip(state.quantities["cfrc_ext"], -task.force_limit, task.force_limit)


def observe(task: Task, state: PhysicsState) -> Array:
    """The observation of a physical state: [O]"""
    velocity = jnp.clip(state.qvel, -task.max_speed, task.max_speed)
    parts = [state.qpos[task.unobserved :], velocity]
    for name in task.quantities:
        quantity = forces(task, state) if name == "cfrc_ext" else state.quantities[name]
        parts.append(quantity if task.observes_world else quantity[WORLD_ENTRIES[name] :])
    return jnp.concatenate(parts)


def reward(task: Task, state: PhysicsState, control: Array, control_step: float, terminated: Array) -> Array:
    """The reward of the control step (`control_step` seconds) that led to `state`: []"""
    gain = task.forward * state.displacement / control_step + task.height * state.qpos[2]
    alive = task.alive if task.alive_at_end else jnp.where(terminated, 0.0, task.alive)
    cost = task.ctrl_cost * jnp.sum(jnp.square(control))
    if task.contact_cost:
        cost += jnp.minimum(task.contact_cost * jnp.sum(jnp.square(forces(task, state))), task.max_contact_cost)
    return gain + alive - cost


def draw_start(task: Task, qpos0: np.ndarray, num_velocities: int, key: Array) -> tuple[Array, Array]:
    """Positions [nq] and velocities [nv] of a random start: the model's rest pose with noise."""
    position_key, velocity_key = jax.random.split(key)
    draw = jax.random.normal if task.normal_velocity else partial(jax.random.uniform, minval=-1.0, maxval=1.0)
    noise = jax.random.uniform(position_key, qpos0.shape, jnp.float32, -task.noise, task.noise)
    return jnp.asarray(qpos0, jnp.float32) + noise, task.noise * draw(velocity_key, (num_velocities,), jnp.float32)


def load_model(task: Task) -> mujoco.MjModel:
    """The task's model, from the installed gymnasium package.

    Raises:
      FileNotFoundError: gymnasium is not installed.
    """
    # Not imported: gymnasium.envs.mujoco needs packages for rendering.
    spec = find_spec("gymnasium")
    if spec is None or spec.origin is None:
        raise FileNotFoundError("the models of the locomotion tasks are in the package gymnasium: not installed")
    path = Path(spec.origin).parent / "envs" / "mujoco" / "assets" / task.xml
    # The cheetah's file uses a deprecated attribute: MuJoCo would write a warning to a file in the current directory.
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    finally:
        mujoco.set_mju_user_warning(handler)


def make_task(name: str, physics: str = "mjx", **options: Any) -> Environment:
    """Make the environment of the row `name` of `TASKS`.

    Args:
      physics: a name in `PHYSICS`.
      **options: of the physics; they override the task's own (`Task.options`).

    Raises:
      FileNotFoundError: gymnasium is not installed.
      ValueError: the physics is unknown, or cannot run on this machine.
      TypeError: the physics has no such option.
    """
    task = TASKS[name]
    model = load_model(task)
    options = {**task.options.get(physics, {}), **options}
    setup = Setup(model=model, frame_skip=task.frame_skip, quantities=task.quantities, tracked=task.tracked)
    robot: Physics = make_physics(physics, setup, **options)
    low, high = model.actuator_ctrlrange.T.astype(np.float32)
    control_step = model.opt.timestep * task.frame_skip

    def place(qpos: Array, qvel: Array) -> tuple[PhysicsState, Array]:
        state = robot.place(qpos, qvel)
        return state, observe(task, state)

    def start(key: Array) -> tuple[PhysicsState, Array]:
        return place(*draw_start(task, model.qpos0, model.nv, key))

    def advance(state: PhysicsState, action: Array) -> tuple[PhysicsState, Array, Array, Array]:
        control = (low + high) / 2 + action * ((high - low) / 2)
        with jax.named_scope("physics"):
            state = robot.advance(state, control)
        terminated = jnp.zeros((), bool) if task.healthy is None else ~task.healthy(state.qpos, state.qvel)
        return state, observe(task, state), reward(task, state, control, control_step, terminated), terminated

    def speed(state: PhysicsState) -> Array:
        return state.displacement / control_step

    observation_size = jax.eval_shape(start, jax.random.key(0))[1].size
    shortest = EPISODE_LENGTH if task.healthy is None else MIN_STEPS_TO_FALL
    return make_environment(
        name,
        observation_size,
        model.nu,
        EPISODE_LENGTH,
        start,
        advance,
        place,
        min_mean_episode_length=shortest,
        speed=speed if task.forward else None,  # standing up is not moving forward
    )
