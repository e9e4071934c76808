"""Environments by name: `make("ant")`, `make("humanoid-v5", "mujoco")`, `make("brax:ant", "spring")`.

To make an environment of your own: `sqt_jax.envs.autoreset.make_environment`.
"""

from typing import Any

from sqt_jax.envs import brax_envs, gym_table
from sqt_jax.envs.gym_table import ALIASES, TASKS
from sqt_jax.envs.gym_tasks import make_task
from sqt_jax.envs.physics import PHYSICS, lacks
from sqt_jax.suggestions import expects_one_of
from sqt_jax.types import Environment

__all__ = ["ALIASES", "PHYSICS", "TASKS", "lacks", "make", "physics_of", "resolve"]


def resolve(name: str) -> str:
    """The canonical name of an environment: of an alias (`walker2d`) or a Gymnasium id (`ant-v5`, `HalfCheetah-v4`).

    Raises:
      ValueError: the name is unknown; the message lists the known names and suggests the nearest.
    """
    if name in brax_envs.NAMES:
        return name
    found = gym_table.versioned(name)
    if found not in TASKS:
        raise ValueError(expects_one_of(name, [*TASKS, *ALIASES, *brax_envs.NAMES]))
    return found


def physics_of(name: str) -> tuple[str, ...]:
    """The names of the physics that an environment (by its canonical name) can run on; the first is the default."""
    return brax_envs.physics_of(name) if name in brax_envs.NAMES else tuple(PHYSICS)


def make(name: str, physics: str | None = None, **options: Any) -> Environment:
    """Make an environment by its name, alias or Gymnasium id.

    Args:
      name: see `resolve`.
      physics: one of `physics_of(name)`; None is the first of them.
      **options: of the physics. mjx and warp: `iterations` and `ls_iterations`, the maximum steps of the constraint
        solver and of its line search (None: the model file's). mujoco: `num_threads`. Brax's have none.

    Raises:
      ValueError: the environment or the physics is unknown, or the physics cannot run on this machine (`lacks`).
      TypeError: the physics has no such option.
    """
    name = resolve(name)
    physics = physics or physics_of(name)[0]
    if physics not in physics_of(name):
        raise ValueError("physics: " + expects_one_of(physics, physics_of(name)))
    if name in brax_envs.NAMES:
        return brax_envs.make_brax(name, physics, **options)
    return make_task(name, physics, **options)
