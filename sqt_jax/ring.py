"""A ring buffer of transitions that stores each observation once; both kinds of replay use it.

A row holds a transition without its `next_obs`: that is the `obs` of the row that the same environment writes next.
Where an episode ended, the next row begins with the start of another episode. The true `next_obs` is then stored in a
second, smaller ring of final observations, and the next row holds its index there. An insert is one in-place update of
each ring; a read is one gather from each.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax.types import Array, Transition

MAX_FINAL_OBS = 2**24  # a row stores an index into `final_obs` as float32, which is exact up to here


class RingState(NamedTuple):
    """A ring's contents. Transitions are numbered from 0 in order of arrival; number k is in row k mod capacity."""

    storage: Array  # [capacity, W]: obs, action, reward, discount, index of the previous row's next obs (-1: this obs)
    final_obs: Array  # [F, O]: next observations of transitions that ended an episode
    final_owner: Array  # [F] int32: the number of the transition that each belongs to; -1: unused
    next_overwritten: Array  # [E] int32: owners of the next E entries of `final_obs` to be overwritten; -1: unused
    last_next_obs: Array  # [E, O]: next observations of the newest E transitions
    inserted: Array  # [] int32: transitions inserted so far
    num_finals: Array  # [] int32: final observations inserted so far
    first_intact: Array  # [] int32: transitions with a smaller number may have lost their next observation


class Ring(NamedTuple):
    """The sizes of a ring, and pure functions of its state.

    Args:
      capacity: transitions, a multiple of `num_envs`.
      observation_size: O.
      action_size: A.
      num_envs: E, transitions inserted at once, one per environment.
      min_mean_episode_length: memory hint: a lower bound on the mean episode length, in steps. 1 is always safe (up to
        a capacity of `MAX_FINAL_OBS`); with a larger value the ring of final observations is smaller. If episodes turn
        out shorter, the oldest transitions become unavailable before their rows are overwritten; none is ever wrong.
    """

    capacity: int
    observation_size: int
    action_size: int
    num_envs: int = 1
    min_mean_episode_length: int = 1

    @property
    def width(self) -> int:
        """W, floats in a row."""
        return self.observation_size + self.action_size + 3

    @property
    def final_capacity(self) -> int:
        """F, the capacity of the ring of final observations."""
        return min(math.ceil(self.capacity / self.min_mean_episode_length) + self.num_envs, MAX_FINAL_OBS)

    def init(self) -> RingState:
        """An empty ring.

        Raises:
          ValueError: the capacity is 0 or no multiple of `num_envs`: an insert would cross the end.
        """
        if self.capacity % self.num_envs or not self.capacity:
            raise ValueError(
                f"the capacity ({self.capacity}) must be a multiple of the rows inserted at once ({self.num_envs})"
            )
        return RingState(
            storage=jnp.zeros((self.capacity, self.width), jnp.float32),
            final_obs=jnp.zeros((self.final_capacity, self.observation_size), jnp.float32),
            final_owner=jnp.full(self.final_capacity, -1, jnp.int32),
            next_overwritten=jnp.full(self.num_envs, -1, jnp.int32),
            last_next_obs=jnp.zeros((self.num_envs, self.observation_size), jnp.float32),
            # Three arrays, not one used three times: a buffer can be donated only once.
            inserted=jnp.zeros((), jnp.int32),
            num_finals=jnp.zeros((), jnp.int32),
            first_intact=jnp.zeros((), jnp.int32),
        )

    def member_axes(self) -> RingState:
        """`jax.vmap`'s axes for the state of a sweep's members: 0 for their own fields, None for shared ones.

        Members insert in lockstep, so `inserted` is equal in all of them. It has no member axis: an insert is then a
        slice update at one row for all, not a scatter.
        """
        axes = RingState(*[0] * len(RingState._fields))  # type: ignore[arg-type]
        return axes._replace(inserted=None)  # type: ignore[arg-type]

    def insert(self, state: RingState, transition: Transition) -> tuple[RingState, Array]:
        """Insert E transitions.

        Args:
          state: of this ring.
          transition: E transitions, [E, ...], one per environment and always in the same order.

        Returns:
          The new state, and the numbers of the transitions whose final observation was overwritten: [E] int32, -1
          where none was.

        Raises:
          ValueError: the transitions have other shapes.
        """
        e, o, a = self.num_envs, self.observation_size, self.action_size
        expected = {"obs": (e, o), "action": (e, a), "reward": (e,), "next_obs": (e, o), "discount": (e,)}
        shapes = {name: jnp.shape(value) for name, value in transition._asdict().items()}
        if shapes != expected:
            raise ValueError(f"expected transitions of {expected}, got {shapes}")
        previous = state.inserted - self.num_envs + jnp.arange(self.num_envs)  # numbers of the E rows before these
        ended = (previous >= 0) & jnp.any(state.last_next_obs != transition.obs, axis=-1)
        order = jnp.cumsum(ended, dtype=jnp.int32) - 1
        lost = jnp.where(ended, state.next_overwritten[order], -1)
        place = jnp.where(ended, (state.num_finals + order) % self.final_capacity, -1)
        columns = transition.reward, transition.discount, place.astype(jnp.float32)
        rows = jnp.concatenate([transition.obs, transition.action, jnp.stack(columns, axis=-1)], axis=-1)
        written = jnp.where(ended, place, self.final_capacity)  # out of bounds: nothing is written
        final_owner = state.final_owner.at[written].set(previous, mode="drop")
        num_finals = state.num_finals + jnp.sum(ended, dtype=jnp.int32)
        return RingState(
            storage=jax.lax.dynamic_update_slice_in_dim(state.storage, rows, state.inserted % self.capacity, axis=0),
            final_obs=state.final_obs.at[written].set(state.last_next_obs, mode="drop"),
            final_owner=final_owner,
            # Read now for the next insert: reading an array just before writing to it makes XLA copy it.
            next_overwritten=final_owner[(num_finals + jnp.arange(self.num_envs)) % self.final_capacity],
            last_next_obs=transition.next_obs,
            inserted=state.inserted + self.num_envs,
            num_finals=num_finals,
            first_intact=jnp.maximum(state.first_intact, jnp.max(lost) + 1),
        ), lost

    def oldest(self, state: RingState) -> Array:
        """The number of the oldest transition from which on all are available: [] int32"""
        return jnp.maximum(state.inserted - self.capacity, state.first_intact)

    def size(self, state: RingState) -> Array:
        """How many transitions are available, from `oldest` to the newest: [] int32"""
        return state.inserted - self.oldest(state)

    def read(self, state: RingState, index: Array) -> Transition:
        """The transitions in rows `index [B]`: [B, ...]"""
        o, a = self.observation_size, self.action_size
        following = (index + self.num_envs) % self.capacity
        row, next_row = jnp.split(state.storage[jnp.concatenate([index, following])], 2)
        place = next_row[:, -1].astype(jnp.int32)
        next_obs = jnp.where(place[:, None] < 0, next_row[:, :o], state.final_obs[jnp.maximum(place, 0)])
        # The rows that follow the newest E are the oldest: the next observations of the newest are in `last_next_obs`.
        env = (index - state.inserted) % self.capacity - (self.capacity - self.num_envs)
        next_obs = jnp.where(env[:, None] < 0, next_obs, state.last_next_obs[jnp.maximum(env, 0)])
        return Transition(
            obs=row[:, :o],
            action=row[:, o : o + a],
            reward=row[:, o + a],
            next_obs=next_obs,
            discount=row[:, o + a + 1],
        )

    # For checkpoints: a row never changes until it is overwritten. It is saved with the final observation it points to.

    def rows(self, state: RingState, first: Array | int, count: int) -> Array:
        """Rows `first` to `first + count - 1`, which must not cross the end, to be saved: [count, W + O]"""
        rows = jax.lax.dynamic_slice_in_dim(state.storage, first, count)
        place = rows[:, -1].astype(jnp.int32)
        final_obs = jnp.where(place[:, None] < 0, 0.0, state.final_obs[jnp.maximum(place, 0)])
        return jnp.concatenate([rows, final_obs], axis=-1)

    def with_rows(self, state: RingState, rows: Array, first: Array | int) -> RingState:
        """The state with saved rows [count, W + O] put back at `first`; restore older rows before newer ones."""
        rows, final_obs = rows[:, : self.width], rows[:, self.width :]
        place = rows[:, -1].astype(jnp.int32)
        # A place is used again after `final_capacity` others: of two rows with the same place, the newer one counts.
        since = jnp.cumsum((place >= 0)[::-1], dtype=jnp.int32)[::-1]
        written = jnp.where((place >= 0) & (since <= self.final_capacity), place, self.final_capacity)
        return state._replace(
            storage=jax.lax.dynamic_update_slice_in_dim(state.storage, rows, first, axis=0),
            final_obs=state.final_obs.at[written].set(final_obs, mode="drop"),
        )

    def without_rows(self, state: RingState) -> RingState:
        """The state without the arrays that `with_rows` restores: None in their fields."""
        return state._replace(storage=None, final_obs=None)  # type: ignore[arg-type]
