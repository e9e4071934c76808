"""Prioritised replay for TD7: LAP (https://arxiv.org/abs/2007.06049).

A row is drawn with probability proportional to its priority. Priorities are stored in blocks of 128, with a level of
sums of blocks, a level of sums of those, and so on. A draw reads one block of each level, a new priority rewrites one
sum of each level; neither grows with the capacity. A sum is always computed from its block, never adjusted: rounding
errors cannot accumulate. The largest priority of each block is kept too, so that the largest of all is found without a
branch.
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
    block_max: Array  # [blocks]: the largest priority of each block
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
        block_max = jnp.zeros(len(levels[0]))
        return LapState(rows=ring.init(), levels=levels, block_max=block_max, max_priority=jnp.ones(()))

    def with_priorities(state: LapState, index: Array, value: Array) -> LapState:
        """The state with the priorities `value [B]` of the rows `index [B]`."""
        levels, block = set_priorities(state.levels, index, value), index // BLOCK
        block_max = state.block_max.at[block].set(jnp.max(levels[0][block], axis=-1))
        return state._replace(levels=levels, block_max=block_max)

    def insert(state: LapState, transition: Transition) -> LapState:
        rows, lost = ring.insert(state.rows, transition)
        new = state.rows.inserted % ring.capacity + jnp.arange(ring.num_envs)
        # A transition without its final observation gets priority 0. If there is none, a new row is set twice.
        gone = lost >= jnp.maximum(rows.inserted - ring.capacity, 0)
        index = jnp.concatenate([new, jnp.where(gone, lost % ring.capacity, new)])
        value = jnp.where(jnp.concatenate([jnp.zeros_like(gone), gone]), 0.0, state.max_priority)
        return with_priorities(state._replace(rows=rows), index, value)

    def sample(state: LapState, key: Array) -> tuple[Transition, Array]:
        index = draw_rows(key, state.levels, batch_size)
        return ring.read(state.rows, index), index

    def feedback(state: LapState, index: Array, td_error: Array, step: Array) -> LapState:
        new = priority(td_error, priority_exponent, min_priority)
        highest = jnp.maximum(state.max_priority, jnp.max(new))
        available = state.levels[0][index // BLOCK, index % BLOCK] > 0  # not lost since it was drawn
        state = with_priorities(state, index, jnp.where(available, new, 0.0))
        refresh = step % refresh_every == 0
        return state._replace(max_priority=jnp.where(refresh, jnp.max(state.block_max), highest))

    def rows(state: LapState, first: Array | int, count: int) -> Array:
        return ring.rows(state.rows, first, count)

    def with_rows(state: LapState, rows: Array, first: Array | int) -> LapState:
        # Checkpoints have the priorities without their blocks' largest ones.
        block_max = jnp.max(state.levels[0], axis=-1)
        return state._replace(rows=ring.with_rows(state.rows, rows, first), block_max=block_max)

    def without_rows(state: LapState) -> LapState:
        return state._replace(rows=ring.without_rows(state.rows), block_max=None)  # type: ignore[arg-type]

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
        member_axes=LapState(rows=ring.member_axes(), levels=0, block_max=0, max_priority=0),  # type: ignore[arg-type]
    )
