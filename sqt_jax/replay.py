"""The replay buffer: a ring of transitions on the device, written in place.

A transition is stored as one row of floats, so that an insert is one update of the storage and a batch is one gather.
The pointer and the size are scalars that all members of a sweep share (they insert in lockstep); only the storage
has a member axis.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax.types import Array, Replay, Transition


class UniformState(NamedTuple):
    storage: Array  # [capacity, W], W = 2 O + A + 2
    pointer: Array  # [] int32: where the next row goes
    size: Array  # [] int32: rows filled


def row_width(observation_size: int, action_size: int) -> int:
    """Floats per stored transition."""
    return 2 * observation_size + action_size + 2


def pack(transition: Transition) -> Array:
    """[..., fields] -> [..., W]"""
    t = transition
    return jnp.concatenate([t.obs, t.action, t.next_obs, t.reward[..., None], t.discount[..., None]], axis=-1)


def unpack(row: Array, observation_size: int, action_size: int) -> Transition:
    """[..., W] -> [..., fields]"""
    o, a = observation_size, action_size
    return Transition(
        obs=row[..., :o],
        action=row[..., o : o + a],
        next_obs=row[..., o + a : 2 * o + a],
        reward=row[..., 2 * o + a],
        discount=row[..., 2 * o + a + 1],
    )


def uniform(capacity: int, batch_size: int, observation_size: int, action_size: int) -> Replay:
    """A buffer that samples uniformly with replacement among the rows it holds.

    `capacity` must be a multiple of the number of transitions inserted at once, so that no insert straddles the end.
    """

    def init() -> UniformState:
        storage = jnp.zeros((capacity, row_width(observation_size, action_size)), jnp.float32)
        return UniformState(storage, pointer=jnp.zeros((), jnp.int32), size=jnp.zeros((), jnp.int32))

    def insert(state: UniformState, transition: Transition) -> UniformState:
        rows = pack(transition)  # [E, W]
        count = rows.shape[0]
        if capacity % count:
            raise ValueError(f"the capacity ({capacity}) must be a multiple of the rows inserted at once ({count})")
        return UniformState(
            storage=jax.lax.dynamic_update_slice_in_dim(state.storage, rows, state.pointer, axis=0),
            pointer=(state.pointer + count) % capacity,
            size=jnp.minimum(state.size + count, capacity),
        )

    def sample(state: UniformState, key: Array) -> tuple[Transition, Array]:
        index = jax.random.randint(key, (batch_size,), 0, state.size)
        return unpack(state.storage[index], observation_size, action_size), index

    def feedback(state: UniformState, index: Array, td_error: Array, gradient_steps: Array) -> UniformState:
        return state  # every row stays as likely as any other

    def storage(state: UniformState) -> Array:
        return state.storage

    def with_storage(state: UniformState, rows: Array) -> UniformState:
        return state._replace(storage=rows)

    return Replay(init, insert, sample, feedback, storage, with_storage)
