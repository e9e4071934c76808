"""What the networks minimise."""

import jax
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


def lap_huber(q: Array, td_target: Array, min_priority: float) -> Array:
    """LAP's Huber loss, summed over critics, averaged over the batch: q [N, B], td_target [B] -> [].

    Quadratic below `min_priority`, linear above, where LAP's sampling makes up for the missing slope
    (https://arxiv.org/abs/2007.06049, section 5).
    """
    error = jnp.abs(q - td_target)
    return jnp.sum(jnp.mean(jnp.where(error < min_priority, 0.5 * error**2, min_priority * error), axis=-1))


def encoder_loss(zsa: Array, next_zs: Array) -> Array:
    """How far zsa [B, Z] is from the next observation's zs [B, Z], which gets no gradient: -> []."""
    return jnp.mean((zsa - jax.lax.stop_gradient(next_zs)) ** 2)
