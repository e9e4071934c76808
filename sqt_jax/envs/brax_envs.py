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

from sqt_jax.envs.autoreset import make_environment
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
EPISODE_LENGTH = 1000  # as in Brax's training configurations


def make_brax(name: str, physics: str) -> Environment:
    """The environment `name` (with its prefix) on one of `PIPELINES`."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that Brax's pipelines are no longer developed
        from brax import envs

        env = envs.get_environment(name.removeprefix(PREFIX), backend=physics)

    def start(key: Array) -> tuple[Any, Array]:
        state = env.reset(key)
        return state, state.obs

    def advance(state: Any, action: Array) -> tuple[Any, Array, Array, Array]:
        # Matrix products in full precision, which GPUs do not give unasked.
        with jax.default_matmul_precision("highest"):
            state = env.step(state, action)
        return state, state.obs, state.reward, state.done > 0

    return make_environment(name, env.observation_size, env.action_size, EPISODE_LENGTH, start, advance)
