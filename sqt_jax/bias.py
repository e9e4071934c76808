"""The bias of critics: Q(s, a) at the states of an episode minus the discounted return from them.

For SAC the return includes the entropy bonuses of the later actions. Of an episode that the time limit truncates, the
rest of the return is unknown: only states far enough from the limit count, those from which gamma^(steps to the limit)
is at most `TAIL`. Everything is summed while the episode runs; no states or rewards are stored.
"""

from typing import NamedTuple

import jax.numpy as jnp

from sqt_jax.types import Array, Metrics

TAIL = 0.01  # largest weight, relative to an immediate reward, of the first reward after the time limit
NAMES = ("value_bias", "value_bias_min", "value_bias_normalised")


class Sums(NamedTuple):
    """Sums over some of an episode's states, for E episodes: [E] each."""

    weight: Array  # of gamma^(steps since the state): the factor of the next reward in `returns`
    returns: Array  # of the discounted return from the state, up to the current step
    q_mean: Array  # of the mean over the critics at the state
    q_min: Array  # of the minimum over the critics at the state
    states: Array  # the number of states

    @classmethod
    def start(cls, num_episodes: int) -> "Sums":
        """Sums over no states."""
        return cls(*(jnp.zeros(num_episodes) for _ in cls._fields))

    def add(self, counts: Array, reward: Array, bonus: Array, q: Array, gamma: Array) -> "Sums":
        """The sums after one more step.

        Args:
          counts: [E], 1 where the step's state belongs to the sums, else 0.
          reward: [E], of the step.
          bonus: [E], the entropy bonus of the step's action.
          q: [N, E], the critics at the step's state and action.
          gamma: [], the discount factor.
        """
        earlier = gamma * self.weight
        weight = earlier + counts
        return Sums(
            weight=weight,
            # Q(s, a) includes the reward of a, and the bonuses of the actions after a.
            returns=self.returns + weight * reward + earlier * bonus,
            q_mean=self.q_mean + counts * jnp.mean(q, axis=0),
            q_min=self.q_min + counts * jnp.min(q, axis=0),
            states=self.states + counts,
        )


class BiasSums(NamedTuple):
    """Running sums for E episodes, from which `result` computes the bias.

    `all_states` is used if the episode terminates; `early_states`, which leaves out states too close to the time limit,
    if it is truncated.
    """

    all_states: Sums
    early_states: Sums

    @classmethod
    def start(cls, num_episodes: int) -> "BiasSums":
        """Sums before the first step of `num_episodes` episodes."""
        return cls(Sums.start(num_episodes), Sums.start(num_episodes))

    def add(
        self, running: Array, steps_left: Array | int, reward: Array, bonus: Array, q: Array, gamma: Array
    ) -> "BiasSums":
        """The sums after one more step of the episodes that are still `running`.

        Args:
          running: [E] bool; the other episodes have ended, and nothing is added to theirs.
          steps_left: [], steps from this state to the time limit.
          reward, bonus, q, gamma: as in `Sums.add`.
        """
        # Masked here too: in `Sums`, a reward after the end would count towards the return of earlier states.
        reward, bonus = jnp.where(running, reward, 0.0), jnp.where(running, bonus, 0.0)
        early = running & (gamma**steps_left <= TAIL)
        return BiasSums(
            self.all_states.add(running.astype(jnp.float32), reward, bonus, q, gamma),
            self.early_states.add(early.astype(jnp.float32), reward, bonus, q, gamma),
        )

    def result(self, terminated: Array) -> Metrics:
        """The bias, as means over the states of all E episodes that count: [] each, NaN if none counts.

        Args:
          terminated: [E] bool; the other episodes were truncated.

        Returns:
          By `NAMES`: value_bias: mean over the critics minus return; value_bias_min: minimum over the critics minus
          return; value_bias_normalised: value_bias divided by |mean return| (REDQ,
          https://arxiv.org/abs/2101.05982), NaN where that is 0 or the quotient overflows.
        """
        sums = Sums(
            *(
                jnp.sum(jnp.where(terminated, full, early))
                for full, early in zip(self.all_states, self.early_states, strict=True)
            )
        )
        returns, q_mean, q_min = (x / sums.states for x in (sums.returns, sums.q_mean, sums.q_min))
        bias = q_mean - returns
        normalised = bias / jnp.abs(returns)
        return {
            "value_bias": bias,
            "value_bias_min": q_min - returns,
            "value_bias_normalised": jnp.where(jnp.isfinite(normalised), normalised, jnp.nan),
        }
