"""The replay buffer that samples uniformly, on the device and written in place."""

import jax

from sqt_jax.ring import Ring, RingState
from sqt_jax.types import Array, Replay, Transition


def uniform(ring: Ring, batch_size: int) -> Replay:
    """A buffer that samples uniformly with replacement among the transitions that `ring` holds."""

    def insert(state: RingState, transition: Transition) -> RingState:
        return ring.insert(state, transition)[0]

    def sample(state: RingState, key: Array) -> tuple[Transition, Array]:
        number = jax.random.randint(key, (batch_size,), ring.oldest(state), state.inserted)
        index = number % ring.capacity
        return ring.read(state, index), index

    def feedback(state: RingState, index: Array, td_error: Array, gradient_steps: Array) -> RingState:
        return state  # every transition stays as likely as any other

    return Replay(
        ring.capacity, ring.init, insert, sample, feedback, ring.size, ring.rows, ring.with_rows, ring.without_rows
    )
