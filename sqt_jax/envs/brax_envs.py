"""Brax's own environments, `brax:ant` and so on, through this repository's contract.

Their observations and rewards are Brax's, not Gymnasium's. Brax's wrappers are not used: its automatic restart goes
back to the first start and loses the last observation
(https://github.com/google/brax/blob/main/brax/envs/wrappers/training.py).
"""

import contextlib
import io
import warnings
from typing import Any

import jax
import jax.numpy as jnp

from sqt_jax.envs.autoreset import SHORTEST_FALL, make_environment
from sqt_jax.types import Array, Environment

PREFIX = "brax:"
NAMES = tuple(
    PREFIX + name
    for name in (
        "ant",
        "halfcheetah",
        "hopper",
        "humanoid",
        "humanoidstandup",
        "inverted_pendulum",
        "inverted_double_pendulum",
        "pusher",
        "reacher",
        "swimmer",
        "walker2d",
    )
)
PIPELINES = ("mjx", "generalized", "spring", "positional")
ONLY = {"brax:swimmer": ("generalized",)}  # Brax gives it no others
EPISODE_LENGTH = 1000  # as in Brax's training configurations
FALLING = {"brax:ant", "brax:hopper", "brax:humanoid", "brax:walker2d"}
PENDULUMS = {"brax:inverted_pendulum", "brax:inverted_double_pendulum"}  # a push is enough: two steps
# The other tasks never terminate.


def pipelines(name: str) -> tuple[str, ...]:
    """What can compute the environment `name`; the first is the default."""
    return ONLY.get(name, PIPELINES)


def make_brax(name: str, physics: str) -> Environment:
    """The environment `name` (with its prefix) on one of its `pipelines`."""
    env = brax_own(name, physics)

    def start(key: Array) -> tuple[Any, Array]:
        with jax.default_matmul_precision("highest"):  # which GPUs do not give unasked
            state = _strong(env.reset(key))
        return state, state.obs

    def advance(state: Any, action: Array) -> tuple[Any, Array, Array, Array]:
        with jax.default_matmul_precision("highest"):
            state = _strong(env.step(state, action))
        return state, state.obs, state.reward, state.done > 0

    shortest = SHORTEST_FALL if name in FALLING else 1 if name in PENDULUMS else EPISODE_LENGTH
    sizes = env.observation_size, env.action_size, EPISODE_LENGTH
    return make_environment(name, *sizes, start, advance, min_mean_episode_length=shortest)


def brax_own(name: str, physics: str) -> Any:
    """Brax's own object for the environment `name` (with its prefix): a `brax.envs.Env`."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that Brax's pipelines are no longer developed
        from brax import envs

        return envs.get_environment(name.removeprefix(PREFIX), backend=physics)


def _strong(tree: Any) -> Any:
    """Leaves with types of their own: a weak type would be another one to `jit`, which compiles for each."""
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, jnp.result_type(leaf)), tree)
