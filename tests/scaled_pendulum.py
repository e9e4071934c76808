"""Pendulum swing-up with observations in any unit, for experiments/results/normalisation.md.

The motion and the reward are those of Gymnasium's Pendulum-v1
(https://github.com/Farama-Foundation/Gymnasium/blob/main/gymnasium/envs/classic_control/pendulum.py).
"""

import jax
import jax.numpy as jnp

from sqt_jax.envs.autoreset import make_environment
from sqt_jax.types import Environment

SECONDS, GRAVITY, MAX_SPEED, MAX_TORQUE = 0.05, 10.0, 8.0, 2.0  # of a step, m/s², rad/s, Nm; length 1 m, mass 1 kg


def make(scale: float = 1.0) -> Environment:
    """The pendulum; its observations (cos, sin, speed) are multiplied by `scale`."""

    def observe(state):
        angle, speed = state
        return scale * jnp.stack([jnp.cos(angle), jnp.sin(angle), speed])

    def start(key):
        high = jnp.array([jnp.pi, 1.0])
        state = jax.random.uniform(key, (2,), minval=-high, maxval=high)
        return state, observe(state)

    def advance(state, action):
        angle, speed = state
        torque = MAX_TORQUE * action[0]
        from_upright = (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi
        reward = -(from_upright**2 + 0.1 * speed**2 + 0.001 * torque**2)
        acceleration = 1.5 * GRAVITY * jnp.sin(angle) + 3.0 * torque
        speed = jnp.clip(speed + SECONDS * acceleration, -MAX_SPEED, MAX_SPEED)
        state = jnp.stack([angle + SECONDS * speed, speed])
        return state, observe(state), reward, jnp.zeros((), bool)

    return make_environment("pendulum", 3, 1, 200, start, advance)
