"""Brax's own environments (`brax:ant`, ...), under this repository's episode contract (`autoreset`).

Their observations and rewards are Brax's, not Gymnasium's. Brax's wrappers are not used: their auto-reset returns to
the first start and loses the last observation of an episode
(https://github.com/google/brax/blob/main/brax/envs/wrappers/training.py).
"""

import contextlib
import io
import warnings
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp

from sqt_jax import trees
from sqt_jax.envs.autoreset import MIN_STEPS_TO_FALL, make_environment
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
PHYSICS = ("mjx", "generalized", "spring", "positional")  # Brax's "backends"
ONLY_PHYSICS = {"brax:swimmer": ("generalized",)}  # Brax's swimmer supports no other
EPISODE_LENGTH = 1000  # as in Brax's training configurations
# Tasks that terminate; the others never do.
FALLING = {"brax:ant", "brax:hopper", "brax:humanoid", "brax:walker2d"}
PENDULUMS = {"brax:inverted_pendulum", "brax:inverted_double_pendulum"}  # can fall within two steps


def physics_of(name: str) -> tuple[str, ...]:
    """The physics that the environment `name` (with its prefix) can run on; the first is the default."""
    return ONLY_PHYSICS.get(name, PHYSICS)


def make_brax(name: str, physics: str) -> Environment:
    """The environment `name` (with its prefix) on one of its `physics_of`. It has no `set_physics` and no `speed`."""
    env = brax_own(name, physics)

    def start(key: Array) -> tuple[Any, Array]:
        with jax.default_matmul_precision("highest"):  # GPUs would use TF32
            state = trees.strong(env.reset(key))
        return state, state.obs

    def advance(state: Any, action: Array) -> tuple[Any, Array, Array, Array]:
        with jax.default_matmul_precision("highest"):
            state = trees.strong(env.step(state, action))
        return state, state.obs, state.reward, state.done > 0

    shortest = MIN_STEPS_TO_FALL if name in FALLING else 1 if name in PENDULUMS else EPISODE_LENGTH
    return make_environment(
        name,
        env.observation_size,
        env.action_size,
        EPISODE_LENGTH,
        start,
        advance,
        min_mean_episode_length=shortest,
    )


def brax_own(name: str, physics: str) -> Any:
    """Brax's own object for the environment `name` (with its prefix): a `brax.envs.Env`."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Brax warns that its physics are no longer developed
        from brax import envs, fluid

        # Brax 0.14's fluid forces (the swimmer's) call `clip(x, a_min=...)`, which JAX 0.10 no longer accepts.
        fluid.jp = SimpleNamespace(**vars(jnp) | {"clip": lambda x, a_min: jnp.maximum(x, a_min)})
        return envs.get_environment(name.removeprefix(PREFIX), backend=physics)
