"""What the networks minimise."""

import jax.numpy as jnp

from sqt_jax.types import Array


def critic_loss(q: Array, td_target: Array) -> Array:
    """Sum over critics of the mean squared TD error: q [N, B], td_target [B] -> []."""
    return jnp.sum(jnp.mean((q - td_target) ** 2, axis=-1))


ACTOR_REDUCTIONS = {
    "mean": lambda q: jnp.mean(q, axis=0),  # paper eq. 9
    "min": lambda q: jnp.min(q, axis=0),  # SAC's paper
    "first": lambda q: q[0],  # TD3's paper
}


def actor_value(q: Array, reduce: str) -> Array:
    """What the actor maximises of the N critics at its own action: [N, B] -> [B]."""
    return ACTOR_REDUCTIONS[reduce](q)


def temperature_loss(log_temperature: Array, log_prob: Array, target_entropy: float) -> Array:
    """SAC's dual loss for the temperature, log_prob [B] -> [] (https://arxiv.org/abs/1812.05905, eq. 18)."""
    return -jnp.exp(log_temperature) * jnp.mean(log_prob + target_entropy)
