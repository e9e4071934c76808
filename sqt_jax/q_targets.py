"""The conservative Q-target of SQT ("std Q-target"), usable on its own in any ensemble actor-critic.

    bootstrap_value = reduce_i Q_i(s', a') - entropy_term - penalty
    td_target       = reward + gamma * discount * bootstrap_value
    penalty         = coef * mean_b std_i Q_i(s'_b, a'_b)      SQT        (paper eq. 20: one scalar per batch)
                    = coef * std_i Q_i(s', a')                 SQT-tuple  (paper eq. 19: one value per transition)

Penalties and reductions are functions of `next_q [N, B]`, the N *target* critics at (s', a') of the batch. A new
one is a function here and its row in `PENALTIES` or `REDUCTIONS`. Bind their settings: `partial(batch_std, coef=0.5)`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

Array = jax.Array
Formula = Callable[..., Array]  # a penalty, next_q [N, B] -> [] or [B], or a reduction, next_q [N, B] -> [B]


def min_over_critics(next_q: Array) -> Array:
    """Clipped double Q for N = 2 (TD3, https://arxiv.org/abs/1802.09477), MaxMin for more. [N, B] -> [B]"""
    return jnp.min(next_q, axis=0)


def mean_over_critics(next_q: Array) -> Array:
    """[N, B] -> [B]"""
    return jnp.mean(next_q, axis=0)


def min_over_subset(next_q: Array, subset: Array) -> Array:
    """The minimum over the critics of `subset [M]` (REDQ, https://arxiv.org/abs/2101.05982). [N, B] -> [B]"""
    return jnp.min(next_q[subset], axis=0)


def random_subset(key: Array, ensemble_size: int, subset_size: int) -> Array:
    """Indices [M] of a random subset of the critics. Raises ValueError if there are fewer than `subset_size`."""
    if not 1 <= subset_size <= ensemble_size:
        raise ValueError(f"expected a subset of 1 to {ensemble_size} critics, not {subset_size}")
    return jax.random.permutation(key, ensemble_size)[:subset_size]


def std_over_critics(next_q: Array, ddof: int = 1) -> Array:
    """The disagreement of the ensemble, [N, B] -> [B]. `ddof=1` divides by N - 1, as the authors' code does (torch).

    Raises:
      ValueError: fewer than two critics, or `ddof` not below N.
    """
    ensemble_size = next_q.shape[0]
    if ensemble_size < 2:
        raise ValueError("a penalty needs at least 2 critics: one critic has no disagreement")
    if not 0 <= ddof < ensemble_size:
        raise ValueError(f"ddof must be at least 0 and below the number of critics ({ensemble_size}), not {ddof}")
    return jnp.std(next_q, axis=0, ddof=ddof)


def no_penalty(next_q: Array, *, coef: Array | float = 0.0, ddof: int = 1) -> Array:
    """The baseline: []"""
    return jnp.zeros((), next_q.dtype)


def batch_std(next_q: Array, *, coef: Array | float, ddof: int = 1, axis_name: str | None = None) -> Array:
    """SQT's penalty (eq. 20): [N, B] -> []. `axis_name` is the mapped axis over which a batch is split, if it is."""
    disagreement = jnp.mean(std_over_critics(next_q, ddof))
    if axis_name is not None:
        disagreement = jax.lax.pmean(disagreement, axis_name)
    return coef * disagreement


def transition_std(next_q: Array, *, coef: Array | float, ddof: int = 1) -> Array:
    """SQT-tuple's penalty (eq. 19): [N, B] -> [B]"""
    return coef * std_over_critics(next_q, ddof)


# The setting `penalty`: called with next_q [N, B] and the settings `penalty_coef` (as coef) and `ddof`.
PENALTIES: dict[str, Formula] = {
    "none": no_penalty,
    "batch_std": batch_std,
    "transition_std": transition_std,
}
# The setting `reduce`: called with next_q [N, B] and the update's random subset [M] of critics.
REDUCTIONS: dict[str, Formula] = {
    "min": lambda q, subset: min_over_critics(q),
    "mean": lambda q, subset: mean_over_critics(q),
    "subset_min": min_over_subset,
}
# The setting `actor_reduce`: what the actor maximises of the critics at its own action, [N, B] -> [B].
ACTOR_REDUCTIONS: dict[str, Formula] = {
    "mean": mean_over_critics,  # paper eq. 9
    "min": min_over_critics,  # SAC's paper
    "first": lambda q: q[0],  # TD3's paper
}


def td_target(
    reward: Array,
    discount: Array,
    next_q: Array,
    *,
    gamma: Array | float,
    reduce: Formula = min_over_critics,
    penalty: Formula = no_penalty,
    entropy_term: Array | float = 0.0,
    value_bounds: tuple[Array, Array] | None = None,
    penalty_inside_gamma: bool = True,
) -> Array:
    """The TD target [B] of all variants, without gradient.

    Args:
      reward: [B].
      discount: [B], 0 where the episode terminated, else 1.
      next_q: [N, B], the target critics at (s', a').
      entropy_term: [B], SAC's temperature * log pi(a'|s').
      value_bounds: (low, high) between which the reduced value is clipped, before anything is subtracted (TD7).
      penalty_inside_gamma: discounted and masked with the value (eqs. 19, 20); else subtracted from every target,
        terminal ones too (as eqs. 4 and 8 are printed).

    Raises:
      ValueError: shapes that would broadcast silently. Under `jax.vmap`, map over members, never over transitions:
        SQT's penalty needs the batch.
    """
    shape = next_q.shape[1:]
    if next_q.ndim != 2 or not jnp.shape(reward) == jnp.shape(discount) == shape:
        shapes = next_q.shape, jnp.shape(reward), jnp.shape(discount)
        raise ValueError(f"next_q, reward and discount have to be [N, B], [B] and [B], not {shapes}")
    value = reduce(next_q)
    if value_bounds is not None:
        value = jnp.clip(value, *value_bounds)
    value = value - entropy_term
    if penalty_inside_gamma:
        target = reward + gamma * discount * (value - penalty(next_q))
    else:
        target = reward + gamma * discount * value - penalty(next_q)
    if target.shape != shape:
        raise ValueError(f"reduce, penalty and entropy_term have to leave {shape} of the values, not {target.shape}")
    return jax.lax.stop_gradient(target)
