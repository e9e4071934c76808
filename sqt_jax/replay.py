"""The uniform replay buffer, on the device and written in place."""

import jax

from sqt_jax.ring import Ring, RingState
from sqt_jax.types import Array, Replay, Transition


def uniform(ring: Ring, batch_size: int) -> Replay:
    """A buffer that samples uniformly with replacement from the transitions in `ring`."""

    def insert(state: RingState, transition: Transition) -> RingState:
        return ring.insert(state, transition)[0]

    def sample(state: RingState, key: Array) -> tuple[Transition, Array]:
        number = jax.random.randint(key, (batch_size,), ring.oldest(state), state.inserted)
        index = number % ring.capacity
        return ring.read(state, index), index

    def feedback(state: RingState, index: Array, td_error: Array, step: Array) -> RingState:
        return state  # all transitions stay equally likely

    return Replay(
        capacity=ring.capacity,
        init=ring.init,
        insert=insert,
        sample=sample,
        feedback=feedback,
        size=ring.size,
        rows=ring.rows,
        with_rows=ring.with_rows,
        without_rows=ring.without_rows,
        member_axes=ring.member_axes(),
    )
