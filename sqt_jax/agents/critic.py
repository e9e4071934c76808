"""What every agent's critics have in common: the target of the variant, one step, and what is reported of it."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from sqt_jax import losses, q_targets
from sqt_jax.config import AgentConfig
from sqt_jax.networks import Network
from sqt_jax.optimizers import adam_step, overflows
from sqt_jax.types import Array, Metrics, Params, Scalars, Transition

AgentState = TypeVar("AgentState", bound=Any)

# A value of this size is a divergence long before it is infinite: no task here has returns near it.
LARGEST_VALUE = 1e9


def draw_subset(key: Array, config: AgentConfig) -> Array:
    """The critics [M] of an update's target: a random subset where the reduction asks for one, else all."""
    if config.reduce == "subset_min":
        return q_targets.random_subset(key, config.ensemble_size, config.subset_size)
    return jnp.arange(config.ensemble_size)


def _reduction(config: AgentConfig, subset: Array) -> q_targets.Reduction:
    reductions: dict[str, q_targets.Reduction] = {
        "min": q_targets.min_over_critics,
        "mean": q_targets.mean_over_critics,
        "subset_min": functools.partial(q_targets.min_over_subset, subset=subset),
    }
    return reductions[config.reduce]


def _penalty(config: AgentConfig, coef: Array | float) -> q_targets.Penalty:
    penalties: dict[str, q_targets.Penalty] = {
        "none": q_targets.no_penalty,
        "batch_std": functools.partial(q_targets.batch_std, coef=coef, ddof=config.ddof),
        "transition_std": functools.partial(q_targets.transition_std, coef=coef, ddof=config.ddof),
    }
    return penalties[config.penalty]


def td_target(
    config: AgentConfig,
    scalars: Scalars,
    batch: Transition,
    next_q: Array,
    subset: Array,
    entropy_term: Array | float = 0.0,
    value_bounds: tuple[Array, Array] | None = None,
) -> tuple[Array, dict[str, Array]]:
    """The variant's target from the target critics' values `next_q [N, B]` at (s', a').

    Returns:
      td_target [B], and its terms by name: `penalty`, [] or [B].
    """
    penalty = _penalty(config, scalars.penalty_coef)
    target = q_targets.td_target(
        batch.reward,
        batch.discount,
        next_q,
        gamma=scalars.gamma,
        reduce=_reduction(config, subset),
        penalty=penalty,
        entropy_term=entropy_term,
        value_bounds=value_bounds,
        penalty_inside_gamma=config.penalty_inside_gamma,
    )
    return target, {"penalty": penalty(next_q)}


def update(
    apply: Callable[[Params], Array],
    loss: Callable[[Array], Array],
    config: AgentConfig,
    state: AgentState,
    target: Array,
    terms: dict[str, Array],
) -> tuple[AgentState, Array, Metrics]:
    """One Adam step of all critics towards the target.

    Args:
      apply: parameters -> q [N, B], the critics at the batch's (s, a).
      loss: q [N, B] -> [].
      state: an agent's state, with fields `critic`, `critic_opt`, `scalars` and `diverged`.
      target, terms: as `td_target` gives them.

    Returns:
      state, td_error [B] (the largest |Q_i - target| over the critics), metrics. `q_std` is
      eq. 18's std[B]: the mean over the batch of the std over the online critics at (s, a).
      The agent has diverged where the loss or a gradient is not finite or a value passes `LARGEST_VALUE`: the critics
      stay as they were, and td_error is 0.
    """

    def loss_fn(params):
        q = apply(params)
        return loss(q), q

    (loss_value, q), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.critic)
    within = jnp.isfinite(loss_value) & jnp.all(jnp.abs(q) < LARGEST_VALUE)  # a NaN is not
    diverged = state.diverged | ~within | overflows(grads)
    critic, critic_opt = adam_step(state.critic, state.critic_opt, grads, state.scalars.lr, diverged)
    td_error = jnp.where(diverged, 0.0, jnp.max(jnp.abs(q - target), axis=0))
    disagrees = config.ensemble_size > 1
    metrics = {
        "critic_loss": loss_value,
        "q_mean": jnp.mean(q),
        "q_std": jnp.mean(q_targets.std_over_critics(q, config.ddof)) if disagrees else jnp.full((), jnp.nan),
        "td_error": jnp.mean(td_error),
        "td_target": jnp.mean(target),
        "penalty": jnp.mean(terms["penalty"]),
    }
    return state._replace(critic=critic, critic_opt=critic_opt, diverged=diverged), td_error, metrics


def update_by_squares(
    critic_net: Network,
    config: AgentConfig,
    state: AgentState,
    batch: Transition,
    target: Array,
    terms: dict[str, Array],
) -> tuple[AgentState, Array, Metrics]:
    """`update` of critics of (obs, action) alone, on the mean squared error."""
    return update(
        lambda params: critic_net.apply(params, batch.obs, batch.action),
        lambda q: losses.critic_loss(q, target),
        config,
        state,
        target,
        terms,
    )
