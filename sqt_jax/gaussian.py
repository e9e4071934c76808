"""Gaussian policies squashed by tanh (SAC, https://arxiv.org/abs/1801.01290, appendix C)."""

from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from sqt_jax.networks import Dense, Network, hidden_layers
from sqt_jax.types import Array

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0  # SAC's


class Gaussian(NamedTuple):
    """A diagonal Gaussian whose samples are squashed by tanh."""

    mean: Array  # [B, A]
    log_std: Array  # [B, A]

    def mode(self) -> Array:
        """The deterministic action [B, A]: tanh of the mean."""
        return jnp.tanh(self.mean)

    def sample(self, eps: Array) -> tuple[Array, Array]:
        """Action [B, A] and its log-probability [B] for the standard-normal draw `eps [B, A]`.

        Equation 21 with log(1 - tanh(u)²) written as 2 (log 2 - u - softplus(-2u)), which does not underflow.
        """
        u = self.mean + jnp.exp(self.log_std) * eps
        log_prob = -0.5 * eps**2 - self.log_std - 0.5 * jnp.log(2 * jnp.pi)
        correction = 2 * (jnp.log(2.0) - u - jax.nn.softplus(-2 * u))
        return jnp.tanh(u), jnp.sum(log_prob - correction, axis=-1)


def clip_log_std(log_std: Array) -> Array:
    """`log_std`, of any shape, clipped to SAC's limits."""
    return jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX)


class GaussianActor(nn.Module):
    """SAC's policy: obs [B, O] -> the Gaussian before tanh."""

    action_size: int
    hidden: Sequence[int]

    @nn.compact
    def __call__(self, obs: Array) -> Gaussian:
        x = hidden_layers(obs, self.hidden)
        mean = Dense(self.action_size, name="mean")(x)
        log_std = Dense(self.action_size, name="log_std")(x)
        return Gaussian(mean, clip_log_std(log_std))


def gaussian_actor(action_size: int, hidden: Sequence[int]) -> Network:
    """obs [B, O] -> a `Gaussian` of [B, A]"""
    module = GaussianActor(action_size, hidden)
    return Network(init=module.init, apply=module.apply)
