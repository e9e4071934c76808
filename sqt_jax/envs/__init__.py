"""Environments by name: `make("ant")`, `make("humanoid", physics="mjx", iterations=None)`."""

from typing import Any

from sqt_jax.envs.gym_table import ALIASES, TASKS, resolve
from sqt_jax.envs.gym_tasks import make_task
from sqt_jax.envs.physics import PHYSICS
from sqt_jax.types import Environment

__all__ = ["ALIASES", "PHYSICS", "TASKS", "make", "resolve"]


def make(name: str, physics: str = "mjx", **options: Any) -> Environment:
    """Make the environment `name` (an alias of it, or a Gymnasium id) on a simulator, with that simulator's options.

    Raises:
      ValueError: the task or the simulator is unknown.
      TypeError: the simulator has no such option.
    """
    return make_task(resolve(name), physics, **options)
