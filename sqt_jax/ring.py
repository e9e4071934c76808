"""The ring of transitions under both kinds of replay, with each observation stored once.

A row of the ring holds a transition without its next observation, which is the observation of the row that the same
environment fills next. Where it is not, because an episode ended, the true one lies in a smaller ring of final
observations beside, and the row that comes next says where. An insert is one update of each ring, in place; a read is
one gather of each.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax.types import Array, Transition

MAX_FINALS = 2**24  # places up to here are exact as float32


class RingState(NamedTuple):
    """Transitions are numbered in the order in which they come, from 0; number k lies in row k mod capacity.

    `inserted` is equal in all members of a sweep, which insert in lockstep: an insert is at the same row for all.
    """

    storage: Array  # [capacity, W]: obs, action, reward, discount, and where the next obs of the row before lies
    finals: Array  # [F, O]: next observations that no row begins with
    owners: Array  # [F] int32: the number of the transition that each belongs to; -1: none yet
    at_risk: Array  # [E] int32: the owners of the next places to be written to
    newest: Array  # [E, O]: next observations of the newest rows
    inserted: Array  # [] int32: transitions so far
    ended: Array  # [] int32: final observations so far
    whole_from: Array  # [] int32: of the transitions before this one, some have lost their final observation


class Ring(NamedTuple):
    """The sizes of a ring, and pure functions of its state.

    Args:
      capacity: transitions, a multiple of `num_envs`.
      num_envs: E, transitions that are inserted at once, one per environment.
      shortest_episode: steps that episodes take at least, in the mean over a full ring. Room for final observations is
        made for these; where episodes are shorter, the oldest transitions are given up before their rows are. With 1
        none ever is (up to a capacity of `MAX_FINALS`), and nothing is saved.
    """

    capacity: int
    observation_size: int
    action_size: int
    num_envs: int = 1
    shortest_episode: int = 1

    @property
    def width(self) -> int:
        """W, floats of a row."""
        return self.observation_size + self.action_size + 3

    @property
    def finals(self) -> int:
        """F, final observations that there is room for."""
        return min(math.ceil(self.capacity / self.shortest_episode) + self.num_envs, MAX_FINALS)

    def init(self) -> RingState:
        """Raises ValueError for a capacity that is no multiple of `num_envs`: an insert would straddle the end."""
        if self.capacity % self.num_envs or not self.capacity:
            raise ValueError(
                f"the capacity ({self.capacity}) must be a multiple of the rows inserted at once ({self.num_envs})"
            )
        # An array each: a buffer can be donated once only.
        counts = {name: jnp.zeros((), jnp.int32) for name in ("inserted", "ended", "whole_from")}
        return RingState(
            storage=jnp.zeros((self.capacity, self.width), jnp.float32),
            finals=jnp.zeros((self.finals, self.observation_size), jnp.float32),
            owners=jnp.full(self.finals, -1, jnp.int32),
            at_risk=jnp.full(self.num_envs, -1, jnp.int32),
            newest=jnp.zeros((self.num_envs, self.observation_size), jnp.float32),
            **counts,
        )

    def member_axes(self) -> RingState:
        """`vmap` axes: 0, and None for the count of transitions, which lockstep members share."""
        return RingState(**dict.fromkeys(RingState._fields, 0) | {"inserted": None})  # type: ignore[arg-type]

    def insert(self, state: RingState, transition: Transition) -> tuple[RingState, Array]:
        """Takes E transitions, [E, ...]; gives also the numbers of those that lost their final observation, [E] or -1.

        Raises:
          ValueError: other than E transitions of these sizes.
        """
        e, o, a = self.num_envs, self.observation_size, self.action_size
        wanted = {"obs": (e, o), "action": (e, a), "reward": (e,), "next_obs": (e, o), "discount": (e,)}
        given = {name: jnp.shape(value) for name, value in transition._asdict().items()}
        if given != wanted:
            raise ValueError(f"expects transitions of {wanted}, not {given}")
        before = state.inserted - self.num_envs + jnp.arange(self.num_envs)  # the numbers of the rows before
        final = (before >= 0) & jnp.any(state.newest != transition.obs, axis=-1)
        order = jnp.cumsum(final, dtype=jnp.int32) - 1
        lost = jnp.where(final, state.at_risk[order], -1)
        place = jnp.where(final, (state.ended + order) % self.finals, -1)
        columns = transition.reward, transition.discount, place.astype(jnp.float32)
        rows = jnp.concatenate([transition.obs, transition.action, jnp.stack(columns, axis=-1)], axis=-1)
        written = jnp.where(final, place, self.finals)  # there is no such place: nothing is written
        owners = state.owners.at[written].set(before, mode="drop")
        ended = state.ended + jnp.sum(final, dtype=jnp.int32)
        return RingState(
            storage=jax.lax.dynamic_update_slice_in_dim(state.storage, rows, state.inserted % self.capacity, axis=0),
            finals=state.finals.at[written].set(state.newest, mode="drop"),
            owners=owners,
            # Read here for the next time: XLA would copy what is read before it is written to.
            at_risk=owners[(ended + jnp.arange(self.num_envs)) % self.finals],
            newest=transition.next_obs,
            inserted=state.inserted + self.num_envs,
            ended=ended,
            whole_from=jnp.maximum(state.whole_from, jnp.max(lost) + 1),
        ), lost

    def oldest(self, state: RingState) -> Array:
        """The number of the first of the transitions that are all still there: []"""
        return jnp.maximum(state.inserted - self.capacity, state.whole_from)

    def size(self, state: RingState) -> Array:
        """How many these are: []"""
        return state.inserted - self.oldest(state)

    def read(self, state: RingState, index: Array) -> Transition:
        """The transitions in rows `index [B]`."""
        o, a = self.observation_size, self.action_size
        following = (index + self.num_envs) % self.capacity
        row, next_row = jnp.split(state.storage[jnp.concatenate([index, following])], 2)
        place = next_row[:, -1].astype(jnp.int32)
        next_obs = jnp.where(place[:, None] < 0, next_row[:, :o], state.finals[jnp.maximum(place, 0)])
        # What follows the newest rows in the ring is not what comes after them.
        env = (index - state.inserted) % self.capacity - (self.capacity - self.num_envs)
        next_obs = jnp.where(env[:, None] < 0, next_obs, state.newest[jnp.maximum(env, 0)])
        return Transition(row[:, :o], row[:, o : o + a], row[:, o + a], next_obs, row[:, o + a + 1])

    # What checkpoints hold of it: rows that never change, each with the final observation that it points to.

    def rows(self, state: RingState, first: Array | int, count: int) -> Array:
        """The rows `first`, `first + 1`, ..., which do not go round the end: [count, W + O]"""
        rows = jax.lax.dynamic_slice_in_dim(state.storage, first, count)
        place = rows[:, -1].astype(jnp.int32)
        final = jnp.where(place[:, None] < 0, 0.0, state.finals[jnp.maximum(place, 0)])
        return jnp.concatenate([rows, final], axis=-1)

    def with_rows(self, state: RingState, rows: Array, first: Array | int) -> RingState:
        """The state with rows [count, W + O] as `rows` gave them at `first`; older ones have to come before."""
        rows, final = rows[:, : self.width], rows[:, self.width :]
        place = rows[:, -1].astype(jnp.int32)
        # Of two with one place the newer: a place is used again after `finals` others.
        since = jnp.cumsum((place >= 0)[::-1], dtype=jnp.int32)[::-1]
        written = jnp.where((place >= 0) & (since <= self.finals), place, self.finals)
        return state._replace(
            storage=jax.lax.dynamic_update_slice_in_dim(state.storage, rows, first, axis=0),
            finals=state.finals.at[written].set(final, mode="drop"),
        )

    def without_rows(self, state: RingState) -> RingState:
        """The state without what `with_rows` brings back: None in its places."""
        return state._replace(storage=None, finals=None)  # type: ignore[arg-type]
