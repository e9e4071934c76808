"""Prioritised replay for TD7: LAP (https://arxiv.org/abs/2007.06049).

A row is drawn with probability proportional to its priority. The priorities lie in blocks of 128, with the sums of
blocks and the sums of blocks of blocks beside them: a draw reads one block of each level, a new priority rewrites one
sum of each level, so that neither depends on the capacity. Sums are computed anew from their block, never adjusted:
rounding errors cannot accumulate.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax import replay
from sqt_jax.types import Array, Replay, Transition

BLOCK = 128


class LapState(NamedTuple):
    rows: replay.UniformState
    levels: tuple[Array, ...]  # [blocks, BLOCK] each: priorities, sums of their blocks, ...; the last has one block
    maxima: tuple[Array, ...]  # as the levels above the priorities, with maxima in place of sums
    max_priority: Array  # []: what new rows get


def _shapes(capacity: int) -> list[tuple[int, int]]:
    shapes = [(math.ceil(capacity / BLOCK), BLOCK)]
    while shapes[-1][0] > 1:
        shapes.append((math.ceil(shapes[-1][0] / BLOCK), BLOCK))
    return shapes


def priority(td_error: Array, exponent: float, min_priority: float) -> Array:
    """LAP's priority of rows whose largest |TD error| over the critics is `td_error` [B]: [B]"""
    return jnp.maximum(td_error, min_priority) ** exponent


def set_priorities(
    levels: tuple[Array, ...], index: Array, value: Array, reduce: Callable[..., Array] = jnp.sum
) -> tuple[Array, ...]:
    """The priorities `value [B]` for the rows `index [B]`, and the sums above them."""
    changed = []
    for level in levels:
        block, place = index // BLOCK, index % BLOCK
        level = level.at[block, place].set(value)
        changed.append(level)
        index, value = block, reduce(level[block], axis=-1)
    return tuple(changed)


def draw(key: Array, weights: Array) -> Array:
    """For each row of `weights [B, K]` an index with probability proportional to its weight: [B].

    Never one of weight 0, whatever the rounding: a parallel cumulative sum may even fall or rise at such a one.
    """
    cumulative = jnp.cumsum(weights, axis=-1)
    threshold = cumulative[:, -1:] * jax.random.uniform(key, (weights.shape[0], 1))
    possible = weights > 0
    above = possible & (cumulative > threshold)
    last = weights.shape[-1] - 1 - jnp.argmax(possible[:, ::-1], axis=-1)
    return jnp.where(jnp.any(above, axis=-1), jnp.argmax(above, axis=-1), last)


def draw_rows(key: Array, levels: tuple[Array, ...], batch_size: int) -> Array:
    """Indices [B] of rows, each with probability proportional to its priority."""
    index = jnp.zeros(batch_size, jnp.int32)  # the one block of the last level
    for level_key, level in zip(jax.random.split(key, len(levels)), reversed(levels), strict=True):
        index = index * BLOCK + draw(level_key, level[index])
    return index


def lap(
    capacity: int,
    batch_size: int,
    observation_size: int,
    action_size: int,
    priority_exponent: float = 0.4,
    min_priority: float = 1.0,
    refresh_every: int = 250,
) -> Replay:
    """A buffer that samples in proportion to max(|td_error|, min_priority)^priority_exponent.

    New rows get the largest priority seen; every `refresh_every` updates that becomes the largest in the buffer.
    """
    store = replay.uniform(capacity, batch_size, observation_size, action_size)

    def init() -> LapState:
        levels = tuple(jnp.zeros(shape) for shape in _shapes(capacity))
        return LapState(store.init(), levels, levels[1:], jnp.ones(()))

    def assign(state: LapState, index: Array, value: Array) -> LapState:
        levels = set_priorities(state.levels, index, value)
        highest = jnp.max(levels[0][index // BLOCK], axis=-1)
        maxima = set_priorities(state.maxima, index // BLOCK, highest, jnp.max)
        return state._replace(levels=levels, maxima=maxima)

    def insert(state: LapState, transition: Transition) -> LapState:
        index = state.rows.pointer + jnp.arange(transition.reward.shape[0])
        state = assign(state, index, jnp.broadcast_to(state.max_priority, index.shape))
        return state._replace(rows=store.insert(state.rows, transition))

    def sample(state: LapState, key: Array) -> tuple[Transition, Array]:
        index = draw_rows(key, state.levels, batch_size)
        return replay.unpack(state.rows.storage[index], observation_size, action_size), index

    def feedback(state: LapState, index: Array, td_error: Array, gradient_steps: Array) -> LapState:
        new = priority(td_error, priority_exponent, min_priority)
        state = assign(state, index, new)
        highest = jnp.max(state.maxima[-1] if state.maxima else state.levels[0])
        refresh = gradient_steps % refresh_every == 0
        running = jnp.maximum(state.max_priority, jnp.max(new))
        return state._replace(max_priority=jnp.where(refresh, highest, running))

    return Replay(init, insert, sample, feedback)
