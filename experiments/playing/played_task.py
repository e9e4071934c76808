"""The environment that a run's policy plays in, and its model to show."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from experiments.commandline.arguments import UsageError
from experiments.playing import brax_pages, episodes, rendering
from experiments.playing.play_flags import is_brax
from sqt_jax import envs
from sqt_jax.config import Config
from sqt_jax.envs import brax_envs, env_args, factories, gym_ids, gym_tasks, playground_envs
from sqt_jax.experiment import OWN_PHYSICS, env_of, named_env
from sqt_jax.types import Array, Environment, TimeStep


class PlayedTask(NamedTuple):
    """An environment to play in, and the parts that its film needs."""

    env: Environment
    physics: str
    period: float  # seconds per control step; NaN: unknown
    look: Callable[[TimeStep], Any]  # the part of a state to keep, as in `episodes.play`
    scene: Any  # a mujoco.MjModel; for brax:ENV Brax's own environment; None: it cannot be shown


def make_played_task(config: Config, physics: str | None, camera: str, factory: str | None = None) -> PlayedTask:
    """The environment that a member was trained on.

    Args:
      config: of the member.
      physics: None is `mujoco`, and for brax:ENV and playground:ENV the run's.
      camera: the name of one of the model's cameras, or empty.
      factory: `module:function` of an environment of the user's own.

    An environment on the host has its own model and pictures (`gymnasium_performance`).

    Raises:
      UsageError: the task has no such physics or camera, or a package for the physics is missing.
    """
    if factory is not None or config.physics in gym_ids.PHYSICS:
        env = _not_to_be_shown(config, factory)
        return PlayedTask(env=env, physics=config.physics, period=math.nan, look=lambda timestep: (), scene=None)
    brax, playground = is_brax(config.env), config.env.startswith(playground_envs.PREFIX)
    physics = physics or (config.physics if brax or playground else "mujoco")
    if physics not in envs.physics_of(config.env):
        raise UsageError(f"--physics={physics}: expects one of {', '.join(envs.physics_of(config.env))}")
    if missing := envs.lacks(physics):
        raise UsageError(f"--physics={physics}: needs {missing}")
    if brax:
        if camera:
            raise UsageError(f"--camera={camera}: Brax's viewer has its own; expects no camera with {config.env}")
        own = brax_envs.brax_own(config.env, physics)
        return PlayedTask(
            env=envs.make(config.env, physics),
            physics=physics,
            period=float(own.dt),
            look=brax_pages.poses,
            scene=own,
        )
    if playground:
        return _playground(config, physics, camera)
    row = envs.TASKS[config.env]
    model = gym_tasks.load_model(row)
    try:
        rendering.view_of(model, camera)
    except ValueError as error:
        raise UsageError(f"--camera={camera}: {error}") from None
    return PlayedTask(
        env=envs.make(config.env, physics),
        physics=physics,
        period=model.opt.timestep * row.frame_skip,
        look=episodes.configuration,
        scene=model,
    )


def _playground(config: Config, physics: str, camera: str) -> PlayedTask:
    """One of Playground's, with its own model."""
    arguments = env_args.parse(config.env_args)
    try:
        env = named_env(config, physics)
        own = playground_envs.load(config.env, physics, arguments, config.max_episode_steps)
    except ValueError as error:
        raise UsageError(f"--env={config.env}: {error}") from error
    try:
        rendering.view_of(own.env.mj_model, camera)
    except ValueError as error:
        raise UsageError(f"--camera={camera}: {error}") from None

    def look(timestep: TimeStep) -> tuple[Array, Array]:
        data = timestep.state.task.data
        return jnp.concatenate([data.qpos, data.mocap_pos.reshape(-1), data.mocap_quat.reshape(-1)]), data.qvel

    return PlayedTask(env=env, physics=physics, period=own.period, look=look, scene=own.env.mj_model)


def _not_to_be_shown(config: Config, factory: str | None) -> Environment:
    """The environment of `gym:ID`, or of `module:function`."""
    try:
        if factory is None or config.physics != OWN_PHYSICS:
            return named_env(config, config.physics, in_program=False)
        arguments = env_args.parse(config.env_args)
        return env_of(config, factories.make_from(factory, arguments, config.max_episode_steps, in_program=False))
    except ValueError as error:
        raise UsageError(f"--env={factory or config.env}: {error}") from error
