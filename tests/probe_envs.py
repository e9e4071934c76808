"""Tiny environments with known Q-values, through the same wrapper as the real tasks."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax.envs.autoreset import make_environment
from sqt_jax.types import Environment


def one_step() -> Environment:
    """One step an episode, reward obs - (action - obs)²: the best action is obs and Q*(obs, obs) = obs."""

    def start(key):
        obs = jax.random.uniform(key, (1,), minval=-0.5, maxval=0.5)
        return obs, obs

    def advance(state, action):
        reward = state[0] - (action[0] - state[0]) ** 2
        return state, state, reward, jnp.ones((), bool)

    return make_environment("one_step", 1, 1, 10, start, advance)


def shorter_than_stated() -> Environment:
    """`one_step`, whose replay has room for the final observations of longer episodes."""
    return one_step()._replace(min_mean_episode_length=8)


@functools.cache  # the same environment is the same object, so that its runs can share their programs
def constant_reward(episode_length: int = 5) -> Environment:
    """Reward 1 at each step; only the time limit ends episodes, so Q = 1 / (1 - gamma) everywhere."""

    def start(key):
        obs = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        return obs, obs

    def advance(state, action):
        return state, state, jnp.ones(()), jnp.zeros((), bool)

    return make_environment("constant_reward", 2, 1, episode_length, start, advance)


def countdown(length: int = 3) -> Environment:
    """Reward 1 a step, terminated after `length` steps: Q = 1 + gamma + ... over the steps left."""

    def start(key):
        del key
        return jnp.zeros(()), jnp.zeros((1,))

    def advance(state, action):
        state = state + 1
        return state, state[None], jnp.ones(()), state >= length

    return make_environment("countdown", 1, 1, 100, start, advance)


class Named(NamedTuple):
    inserted: jax.Array


def with_a_field_called_inserted() -> Environment:
    """A state with a field that has the name of one of the trainer's counters."""

    def start(key):
        value = jax.random.uniform(key, minval=1.0, maxval=2.0)
        return Named(value), value[None]

    def advance(state, action):
        return state, state.inserted[None], state.inserted, jnp.zeros((), bool)

    return make_environment("named", 1, 1, 5, start, advance)


def diverging() -> Environment:
    """An action above 0 makes the observation NaN and the reward infinite; other actions earn 1."""

    def start(key):
        obs = jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)
        return obs, obs

    def advance(state, action):
        broken = action[0] > 0
        return state, jnp.where(broken, jnp.nan, state), jnp.where(broken, jnp.inf, 1.0), jnp.zeros((), bool)

    return make_environment("diverging", 1, 1, 10, start, advance)
