"""Environments by name: `make("ant")`, `make("humanoid", physics="mjx", iterations=None)`."""

from typing import Any

from sqt_jax.envs.gym_tasks import ALIASES, TASKS, make_task
from sqt_jax.envs.physics import PHYSICS
from sqt_jax.names import unknown
from sqt_jax.types import Environment

__all__ = ["ALIASES", "PHYSICS", "TASKS", "make", "resolve"]


def resolve(name: str) -> str:
    """The table's name for a task's name or alias.

    Raises:
      ValueError: the name is unknown; the message has the list of names and the nearest one.
    """
    name = ALIASES.get(name, name)
    if name not in TASKS:
        raise ValueError(unknown(name, [*TASKS, *ALIASES]))
    return name


def make(name: str, physics: str = "mjx", **options: Any) -> Environment:
    """Make the environment `name` (or an alias of it) on a simulator, with that simulator's options.

    Raises:
      ValueError: the task or the simulator is unknown.
      TypeError: the simulator has no such option.
    """
    return make_task(resolve(name), physics, **options)
