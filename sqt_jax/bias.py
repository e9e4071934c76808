"""How far critics are from what they estimate: Q(s, a) at the states of an episode against the return from there.

The return is the discounted one of the rest of the episode, for SAC with the entropy bonuses of the later actions. An
episode that the time limit cuts off has no known end: of it, only states count after which so many steps were seen that
what is missing weighs less than `TAIL`. All sums are made as the episode goes along, and nothing of it is kept.
"""

from typing import NamedTuple

import jax.numpy as jnp

from sqt_jax.types import Array, Metrics

TAIL = 0.01  # of the weight of a reward now
NAMES = ("value_bias", "value_bias_min", "value_bias_normalised")


class Sums(NamedTuple):
    """Sums over the states of an episode that count; [E] each."""

    weight: Array  # of gamma^(steps since the state)
    returns: Array  # of the return from the state, as far as it has been seen
    q_mean: Array  # of the mean over the critics at the state
    q_min: Array  # of their minimum
    states: Array  # how many

    @classmethod
    def start(cls, episodes: int) -> "Sums":
        return cls(*(jnp.zeros(episodes) for _ in cls._fields))

    def add(self, counts: Array, reward: Array, bonus: Array, q: Array, gamma: Array) -> "Sums":
        """One step: whether its state counts, its reward, its action's entropy bonus [E] each, and q [N, E]."""
        earlier = gamma * self.weight
        weight = earlier + counts
        return Sums(
            weight=weight,
            # Q(s, a) holds the reward of a, and the bonuses of what comes after a.
            returns=self.returns + weight * reward + earlier * bonus,
            q_mean=self.q_mean + counts * jnp.mean(q, axis=0),
            q_min=self.q_min + counts * jnp.min(q, axis=0),
            states=self.states + counts,
        )


class Judgement(NamedTuple):
    """Of running episodes: the sums over all their states, and over those that count if the time limit ends them."""

    all: Sums
    early: Sums

    @classmethod
    def start(cls, episodes: int) -> "Judgement":
        return cls(Sums.start(episodes), Sums.start(episodes))

    def add(
        self, running: Array, steps_left: Array, reward: Array, bonus: Array, q: Array, gamma: Array
    ) -> "Judgement":
        """One step of the episodes that are `running` [E] bool, `steps_left` [] steps before the time limit."""
        # What does not run adds nothing: the weight of its earlier states would.
        reward, bonus = jnp.where(running, reward, 0.0), jnp.where(running, bonus, 0.0)
        early = running & (gamma**steps_left <= TAIL)
        return Judgement(
            self.all.add(running.astype(jnp.float32), reward, bonus, q, gamma),
            self.early.add(early.astype(jnp.float32), reward, bonus, q, gamma),
        )

    def result(self, terminated: Array) -> Metrics:
        """Means over the states of all episodes that count; NaN where there are none.

        Args:
          terminated: [E] bool: the episodes that ended by themselves.

        Returns:
          By `NAMES`: value_bias: the mean over the critics less the return; value_bias_min: their minimum less the
          return; value_bias_normalised: value_bias in units of the mean return's size (REDQ,
          https://arxiv.org/abs/2101.05982).
        """
        sums = Sums(*(jnp.sum(jnp.where(terminated, a, b)) for a, b in zip(self.all, self.early, strict=True)))
        returns, q_mean, q_min = (x / sums.states for x in (sums.returns, sums.q_mean, sums.q_min))
        bias = q_mean - returns
        return dict(zip(NAMES, (bias, q_min - returns, bias / jnp.abs(returns)), strict=True))
