"""Environments by name: `make("ant")`, `make("humanoid-v5", "mujoco")`, `make("brax:ant")`, `make("gym:Pendulum-v1")`,
`make("playground:CartpoleBalance")`.

To make an environment of your own: `sqt_jax.envs.autoreset.make_environment`.
"""

from typing import Any

from sqt_jax.envs import brax_envs, gym_ids, gym_table, playground_envs
from sqt_jax.envs.gym_table import ALIASES, TASKS
from sqt_jax.envs.gym_tasks import make_task
from sqt_jax.envs.physics import PHYSICS, lacks
from sqt_jax.suggestions import expects_one_of
from sqt_jax.types import Environment

__all__ = ["ALIASES", "PHYSICS", "TASKS", "is_built_in", "lacks", "make", "physics_of", "resolve", "takes_arguments"]


def resolve(name: str) -> str:
    """The canonical name of an environment: of an alias (`walker2d`) or a Gymnasium id (`ant-v5`, `HalfCheetah-v4`).

    Whether `gym:ID` or `playground:NAME` exists is not checked: it would have to be imported.

    Raises:
      ValueError: the name is unknown; the message lists the known names and suggests the nearest.
    """
    if name in brax_envs.NAMES:
        return name
    if name.startswith(gym_ids.PREFIX):
        gym_ids.check_name(name)
        return name
    if name.startswith(playground_envs.PREFIX):
        playground_envs.check_name(name)
        return name
    found = gym_table.versioned(name)
    if found not in TASKS:
        others = ("gym:ID", "playground:NAME", "MODULE:FUNCTION")
        raise ValueError(expects_one_of(name, [*TASKS, *ALIASES, *brax_envs.NAMES, *others]))
    return found


def is_built_in(name: str) -> bool:
    """Whether an environment (by its canonical name) is made by this package's code alone, without arguments."""
    return name in TASKS or name in brax_envs.NAMES


def takes_arguments(name: str) -> bool:
    """Whether an environment (by its canonical name) takes `env_args` and `max_episode_steps`."""
    return name.startswith((gym_ids.PREFIX, playground_envs.PREFIX))


def physics_of(name: str) -> tuple[str, ...]:
    """The names of the physics that an environment (by its canonical name) can run on; the first is the default."""
    if name.startswith(gym_ids.PREFIX):
        return gym_ids.PHYSICS
    if name.startswith(playground_envs.PREFIX):
        return playground_envs.PHYSICS
    return brax_envs.physics_of(name) if name in brax_envs.NAMES else tuple(PHYSICS)


def make(name: str, physics: str | None = None, **options: Any) -> Environment:
    """Make an environment by its name, alias or Gymnasium id.

    Args:
      name: see `resolve`. `gym:MODULE:ID` imports the module.
      physics: one of `physics_of(name)`; None is the first of them.
      **options: of the physics. mjx and warp: `iterations` and `ls_iterations`, the maximum steps of the constraint
        solver and of its line search (None: the model file's). mujoco: `num_threads`. Brax's have none. gym:ID: as in
        `gym_ids.make_gym`. playground:NAME: `arguments` and `max_episode_steps`, as in `playground_envs.load`.

    Raises:
      ValueError: the environment or the physics is unknown, or the physics cannot run on this machine (`lacks`).
      TypeError: the physics has no such option.
    """
    name = resolve(name)
    physics = physics or physics_of(name)[0]
    if physics not in physics_of(name):
        raise ValueError("physics: " + expects_one_of(physics, physics_of(name)))
    if name.startswith(gym_ids.PREFIX):
        return gym_ids.make_gym(name, **options)
    if name.startswith(playground_envs.PREFIX):
        if missing := lacks(physics):
            raise ValueError(f"physics {physics} needs {missing}")
        return playground_envs.make_playground(name, physics, **options)
    if name in brax_envs.NAMES:
        return brax_envs.make_brax(name, physics, **options)
    return make_task(name, physics, **options)
