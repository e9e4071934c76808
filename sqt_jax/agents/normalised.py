"""Observations normalised by their running mean and variance, around any agent (`--normalize_observations`).

The statistics are of the observations that the behaviour acts on (`Agent.see`), and part of the agent's state. The
replay keeps raw observations: an update normalises its batch by the current statistics.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax import trees
from sqt_jax.types import Array, Metrics, Params, Parts, Scalars, State, Transition, Views, assemble

LIMIT = 10.0  # of a normalised observation
# Added to the variance: a constant dimension becomes 0, and one whose std is below 1e-4 stays smaller than others.
EPSILON = 1e-8


class Moments(NamedTuple):
    """Mean and variance of each dimension of observations."""

    mean: Array  # [O]
    variance: Array  # [O], ddof 0


class Statistics(NamedTuple):
    """The moments of the observations so far."""

    seen: Array  # [] int32: how many
    moments: Moments  # mean 0 and variance 1 before the first observation
    # What rounding has cut off the moments (compensated summation): one of many observations changes a mean of 10,000
    # by less than a digit of float32.
    cut_off: Moments

    @classmethod
    def start(cls, observation_size: int) -> "Statistics":
        """Statistics of no observations."""
        zeros, ones = jnp.zeros(observation_size), jnp.ones(observation_size)
        return cls(
            seen=jnp.zeros((), jnp.int32),
            moments=Moments(mean=zeros, variance=ones),
            cut_off=Moments(mean=zeros, variance=zeros),
        )


def add(statistics: Statistics, obs: Array) -> Statistics:
    """The statistics with further observations [E, O], each below 1e10.

    The parallel formula of Chan, Golub and LeVeque (http://i.stanford.edu/pub/cstr/reports/cs/tr/79/773/CS-TR-79-773.pdf)
    for means instead of sums: they stay near the values, and neither overflow nor lose digits as sums do.
    """
    seen = statistics.seen + len(obs)
    share = jnp.float32(len(obs)) / seen.astype(jnp.float32)  # of the new observations, 1 for the first ones
    # The first moments stand for no observation.
    old, cut_off = trees.where(
        statistics.seen > 0,
        (statistics.moments, statistics.cut_off),
        jax.tree.map(jnp.zeros_like, (statistics.moments, statistics.cut_off)),
    )
    # Relative to one of them, which keeps the digits of a small variance around a large mean.
    relative = obs - obs[0]
    centre = jnp.mean(relative, axis=0)
    variance = jnp.mean((relative - centre) ** 2, axis=0)
    difference = (obs[0] - old.mean) + centre
    spread = (1 - share) * difference**2
    mean, mean_cut_off = _compensated_sum(old.mean, cut_off.mean, share * difference)
    variance, variance_cut_off = _compensated_sum(
        old.variance, cut_off.variance, share * (variance - old.variance + spread)
    )
    return Statistics(
        seen=seen,
        moments=Moments(mean=mean, variance=variance),
        cut_off=Moments(mean=mean_cut_off, variance=variance_cut_off),
    )


def _compensated_sum(x: Array, cut_off: Array, step: Array) -> tuple[Array, Array]:
    """x + cut_off + step, and what rounding cuts off this sum (Knuth's TwoSum, exact whichever is larger)."""
    step = cut_off + step
    total = x + step
    of_step = total - x
    return total, (x - (total - of_step)) + (step - of_step)


def normalise(moments: Moments, obs: Array) -> Array:
    """(obs - mean) / std for obs [..., O], clipped to ±10, with the constants of Stable-Baselines3's VecNormalize.

    https://stable-baselines3.readthedocs.io/en/master/guide/vec_envs.html#vecnormalize
    """
    return jnp.clip((obs - moments.mean) / jnp.sqrt(moments.variance + EPSILON), -LIMIT, LIMIT)


class NormalisedPolicy(NamedTuple):
    """The parameters of a policy, and the moments of its observations."""

    policy: Params
    moments: Moments


class NormalisedState(NamedTuple):
    """The state of an agent, and the statistics of its observations."""

    learner: State
    statistics: Statistics

    @property
    def scalars(self) -> Scalars:
        return self.learner.scalars

    @property
    def diverged(self) -> Array:
        return self.learner.diverged


def around(learner: Parts, observation_size: int) -> Parts:
    """The learner's agent for raw observations: it gets and learns from normalised ones."""
    agent, views = learner.agent, learner.agent.views

    def init(key: Array, scalars: Scalars | None = None) -> NormalisedState:
        return NormalisedState(learner=agent.init(key, scalars), statistics=Statistics.start(observation_size))

    def see(state: NormalisedState, obs: Array) -> NormalisedState:
        statistics = add(state.statistics, obs)
        # A diverged agent stays at its last good state, with its statistics.
        return state._replace(statistics=trees.where(state.diverged, state.statistics, statistics))

    def normal(state: NormalisedState, obs: Array) -> Array:
        return normalise(state.statistics.moments, obs)

    def normal_batch(state: NormalisedState, batch: Transition) -> Transition:
        return batch._replace(obs=normal(state, batch.obs), next_obs=normal(state, batch.next_obs))

    def act(state: NormalisedState, obs: Array, key: Array, deterministic: bool = False) -> Array:
        return agent.act(state.learner, normal(state, obs), key, deterministic)

    def update(
        state: NormalisedState, batch: Transition, draws: Any, step: Array
    ) -> tuple[NormalisedState, Array, Metrics]:
        learned, td_error, metrics = learner.update(state.learner, normal_batch(state, batch), draws, step)
        return state._replace(learner=learned), td_error, metrics

    def td_target(state: NormalisedState, batch: Transition, draws: Any) -> tuple[Array, dict[str, Array]]:
        return learner.td_target(state.learner, normal_batch(state, batch), draws)

    def policy_action(policy: NormalisedPolicy, obs: Array) -> Array:
        return views.policy_action(policy.policy, normalise(policy.moments, obs))

    def sample(state: NormalisedState, obs: Array, key: Array) -> tuple[Array, Array]:
        assert views.sample
        return views.sample(state.learner, normal(state, obs), key)

    return assemble(
        init=init,
        act=act,
        draw=learner.draw,
        update=update,
        td_target=td_target,
        views=Views(
            policy=lambda state: NormalisedPolicy(policy=views.policy(state.learner), moments=state.statistics.moments),
            policy_action=policy_action,
            q_values=lambda state, obs, action: views.q_values(state.learner, normal(state, obs), action),
            sample=sample if views.sample else None,
            status=lambda state: views.status(state.learner),
        ),
        see=see,
    )
