"""Shared by the critics of all agents: the variant's target, and one update towards it."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from sqt_jax import q_targets
from sqt_jax.config import AgentConfig
from sqt_jax.optimizers import adam_step
from sqt_jax.types import Array, Metrics, Params, Transition

LARGEST_VALUE = 1e9  # a larger |Q| is a divergence, long before it is infinite: no task here has returns near it


def draw_subset(key: Array, config: AgentConfig) -> Array:
    """The critics [M] of an update's target: REDQ's random subset, else all."""
    if config.reduce == "subset_min":
        return q_targets.random_subset(key, config.ensemble_size, config.subset_size)
    return jnp.arange(config.ensemble_size)


def td_target(
    config: AgentConfig, state: Any, batch: Transition, next_q: Array, draws: Any, **terms: Any
) -> tuple[Array, dict[str, Array]]:
    """The variant's td_target [B] from next_q [N, B], and its penalty. `terms`: those of `q_targets.td_target`."""
    penalty = functools.partial(q_targets.PENALTIES[config.penalty], coef=state.scalars.penalty_coef, ddof=config.ddof)
    target = q_targets.td_target(
        batch.reward,
        batch.discount,
        next_q,
        gamma=state.scalars.gamma,
        reduce=functools.partial(q_targets.REDUCTIONS[config.reduce], subset=draws.subset),
        penalty=penalty,
        penalty_inside_gamma=config.penalty_inside_gamma,
        **terms,
    )
    return target, {"penalty": penalty(next_q)}


def squared_error(q: Array, td_target: Array) -> Array:
    """The mean over the batch, summed over critics: q [N, B], td_target [B] -> []."""
    return jnp.sum(jnp.mean((q - td_target) ** 2, axis=-1))


def update(
    config: AgentConfig,
    state: Any,
    q_values: Callable[[Params], Array],
    target: Array,
    terms: dict[str, Array],
    loss: Callable[[Array, Array], Array] = squared_error,
) -> tuple[Any, Array, Metrics]:
    """One Adam step of all critics towards the target [B], with metrics; `q_std` is SQT's eq. 18 (its mean is eq. 17).

    If the loss or a gradient is not finite or a value exceeds `LARGEST_VALUE`, the agent has diverged: the critics stay
    as they were and td_error is 0.

    Args:
      q_values: parameters -> q [N, B], the critics at the batch's (s, a).
      loss: (q [N, B], target [B]) -> [].
    """

    def loss_fn(params):
        q = q_values(params)
        return loss(q, target), q

    (loss_value, q), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.critic)
    in_bounds = jnp.isfinite(loss_value) & jnp.all(jnp.abs(q) < LARGEST_VALUE)  # a NaN is not
    diverged = state.diverged | ~in_bounds
    critic, critic_opt, diverged = adam_step(state.critic, state.critic_opt, grads, state.scalars.lr, diverged)
    td_error = jnp.where(diverged, 0.0, jnp.max(jnp.abs(q - target), axis=0))
    metrics = {
        "critic_loss": loss_value,
        "q_mean": jnp.mean(q),
        "q_std": jnp.mean(q_targets.std_over_critics(q, config.ddof) if len(q) > 1 else jnp.nan),
        "td_error": jnp.mean(td_error),
        "td_target": jnp.mean(target),
        "penalty": jnp.mean(terms["penalty"]),
    }
    return state._replace(critic=critic, critic_opt=critic_opt, diverged=diverged), td_error, metrics
