"""Environments by name: `make("ant")`, `make("humanoid-v5", "mujoco")`, `make("brax:ant", "spring")`."""

from typing import Any

from sqt_jax.envs import brax_envs, gym_table
from sqt_jax.envs.gym_table import ALIASES, TASKS
from sqt_jax.envs.gym_tasks import make_task
from sqt_jax.envs.physics import PHYSICS, lacks
from sqt_jax.names import unknown
from sqt_jax.types import Environment

__all__ = ["ALIASES", "PHYSICS", "TASKS", "lacks", "make", "resolve", "simulators"]


def resolve(name: str) -> str:
    """The table's name for a task's name, alias or Gymnasium id: `ant`, `ant-v5`, `walker2d`, `HalfCheetah-v4`.

    Raises:
      ValueError: the name is unknown; the message has the list of names and the nearest one.
    """
    if name in brax_envs.NAMES:
        return name
    found = gym_table.versioned(name)
    if found not in TASKS:
        raise ValueError(unknown(name, [*TASKS, *ALIASES, *brax_envs.NAMES]))
    return found


def simulators(name: str) -> tuple[str, ...]:
    """The physics that can compute an environment, by its own name; the first is the default."""
    return brax_envs.pipelines(name) if name in brax_envs.NAMES else tuple(PHYSICS)


def make(name: str, physics: str | None = None, **options: Any) -> Environment:
    """Make the environment `name` (an alias of it, or a Gymnasium id) on a simulator, with that simulator's options.

    Without `physics`, on the first of its `simulators`. Options are, of mjx and warp, `iterations` and `ls_iterations`
    (most steps of the constraint solver and of its line search, None: the model file's); of mujoco `num_threads`.

    Raises:
      ValueError: the environment or the simulator is unknown, or the simulator cannot run here (`lacks`).
      TypeError: the simulator has no such option.
    """
    name = resolve(name)
    physics = physics or simulators(name)[0]
    if physics not in simulators(name):
        raise ValueError("physics " + unknown(physics, simulators(name)))
    if name in brax_envs.NAMES:
        return brax_envs.make_brax(name, physics, **options)
    return make_task(name, physics, **options)
