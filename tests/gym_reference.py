"""Steps of Gymnasium's own environments and of ours from recorded states, computed once for all tests.

MJX takes long to compile, so there is one compiled step per task here, of `COUNT` environments.
"""

from functools import cache

import jax

from experiments.gymnasium_parity import gymnasium_reference
from sqt_jax import envs
from sqt_jax.types import Environment, TimeStep

COUNT = 64


@cache
def recorded(name: str) -> gymnasium_reference.Recorded:
    return gymnasium_reference.recorded(name, COUNT)


MJX_TASKS = ("hopper",)  # compiled in the fast suite; the others are marked slow


@cache
def environment(name: str) -> Environment:
    return envs.make(name)


@cache
def compiled_step(name: str):
    return jax.jit(jax.vmap(environment(name).step))


@cache
def placed(name: str) -> TimeStep:
    """The recorded states in our environment."""
    rows = recorded(name)
    return jax.jit(jax.vmap(environment(name).set_physics))(rows.qpos, rows.qvel)


@cache
def ours(name: str) -> tuple[TimeStep, TimeStep]:
    """The recorded states in our environment, and one step from them."""
    return placed(name), compiled_step(name)(placed(name), recorded(name).action)
