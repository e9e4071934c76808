"""Prioritised replay for TD7: LAP (https://arxiv.org/abs/2007.06049).

A row is drawn with probability proportional to its priority. Priorities are stored in blocks of 128, with a level of
sums of blocks, a level of sums of those, and so on. A draw reads one block of each level, a new priority rewrites one
sum of each level; neither depends on the capacity. A sum is always computed from its block, never adjusted: rounding
errors cannot accumulate.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax.ring import Ring, RingState
from sqt_jax.types import Array, Replay, Transition

BLOCK = 128


class LapState(NamedTuple):
    """The transitions, and the priorities from which they are drawn."""

    rows: RingState
    levels: tuple[Array, ...]  # [blocks, BLOCK] each: priorities, sums of their blocks, ...; the last has one block
    max_priority: Array  # []: the priority of new rows


def _shapes(capacity: int) -> list[tuple[int, int]]:
    shapes = [(math.ceil(capacity / BLOCK), BLOCK)]
    while shapes[-1][0] > 1:
        shapes.append((math.ceil(shapes[-1][0] / BLOCK), BLOCK))
    return shapes


def priority(td_error: Array, exponent: float, min_priority: float) -> Array:
    """LAP's priority of rows whose largest |TD error| over the critics is `td_error` [B]: [B]

    An error that is not finite counts as 0: it would spoil every sum above it.
    """
    size = jnp.where(jnp.isfinite(td_error), jnp.abs(td_error), 0.0)
    return jnp.maximum(size, min_priority) ** exponent


def set_priorities(levels: tuple[Array, ...], index: Array, value: Array) -> tuple[Array, ...]:
    """Sets the priorities of the rows `index [B]` to `value [B]`, and updates the sums above them."""
    changed = []
    for level in levels:
        block, place = index // BLOCK, index % BLOCK
        level = level.at[block, place].set(value)
        changed.append(level)
        index, value = block, jnp.sum(level[block], axis=-1)
    return tuple(changed)


def draw(key: Array, weights: Array) -> Array:
    """For each row of `weights [B, K]` an index with probability proportional to its weight: [B].

    Never one of weight 0, however the cumulative sum is rounded: such entries do not count, and the threshold is below
    the highest of the others.
    """
    reached = jnp.where(weights > 0, jnp.cumsum(weights, axis=-1), 0.0)
    threshold = jnp.max(reached, axis=-1, keepdims=True) * jax.random.uniform(key, (weights.shape[0], 1))
    return jnp.argmax(reached > threshold, axis=-1)


def draw_rows(key: Array, levels: tuple[Array, ...], batch_size: int) -> Array:
    """Indices [B] of rows, each with probability proportional to its priority."""
    index = jnp.zeros(batch_size, jnp.int32)  # the one block of the last level
    for level_key, level in zip(jax.random.split(key, len(levels)), reversed(levels), strict=True):
        index = index * BLOCK + draw(level_key, level[index])
    return index


def lap(
    ring: Ring,
    batch_size: int,
    priority_exponent: float = 0.4,
    min_priority: float = 1.0,
    refresh_every: int = 250,
) -> Replay:
    """A buffer that samples in proportion to max(|td_error|, min_priority)^priority_exponent.

    New rows get the largest priority seen; every `refresh_every` updates that becomes the largest in the buffer.
    Transitions that have lost their final observation (`Ring`) are not drawn any more.

    Args:
      ring: the sizes of the store.
      batch_size: B.
      refresh_every: updates between refreshes of the largest priority (TD7: with each copy of its targets).
    """

    def init() -> LapState:
        levels = tuple(jnp.zeros(shape) for shape in _shapes(ring.capacity))
        return LapState(ring.init(), levels, jnp.ones(()))

    def insert(state: LapState, transition: Transition) -> LapState:
        rows, lost = ring.insert(state.rows, transition)
        new = state.rows.inserted % ring.capacity + jnp.arange(ring.num_envs)
        # A transition without its final observation gets priority 0. If there is none, a new row is set twice.
        gone = lost >= jnp.maximum(rows.inserted - ring.capacity, 0)
        index = jnp.concatenate([new, jnp.where(gone, lost % ring.capacity, new)])
        value = jnp.where(jnp.concatenate([jnp.zeros_like(gone), gone]), 0.0, state.max_priority)
        return LapState(rows, set_priorities(state.levels, index, value), state.max_priority)

    def sample(state: LapState, key: Array) -> tuple[Transition, Array]:
        index = draw_rows(key, state.levels, batch_size)
        return ring.read(state.rows, index), index

    def feedback(state: LapState, index: Array, td_error: Array, step: Array) -> LapState:
        new = priority(td_error, priority_exponent, min_priority)
        highest = jnp.maximum(state.max_priority, jnp.max(new))
        available = state.levels[0][index // BLOCK, index % BLOCK] > 0  # not lost since it was drawn
        levels = set_priorities(state.levels, index, jnp.where(available, new, 0.0))
        # Members share the condition: a real branch under vmap. It reads every priority, so it must stay rare.
        refresh = step % refresh_every == 0
        highest = jax.lax.cond(refresh, lambda: jnp.max(levels[0]), lambda: highest)
        return LapState(state.rows, levels, highest)

    def rows(state: LapState, first: Array | int, count: int) -> Array:
        return ring.rows(state.rows, first, count)

    def with_rows(state: LapState, rows: Array, first: Array | int) -> LapState:
        return state._replace(rows=ring.with_rows(state.rows, rows, first))

    def without_rows(state: LapState) -> LapState:
        return state._replace(rows=ring.without_rows(state.rows))

    def size(state: LapState) -> Array:
        return ring.size(state.rows)

    return Replay(
        capacity=ring.capacity,
        init=init,
        insert=insert,
        sample=sample,
        feedback=feedback,
        size=size,
        rows=rows,
        with_rows=with_rows,
        without_rows=without_rows,
        member_axes=LapState(rows=ring.member_axes(), levels=0, max_priority=0),  # type: ignore[arg-type]
    )
