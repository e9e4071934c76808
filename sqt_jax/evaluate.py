"""Episodes of a fixed policy from fresh starts."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax import rollout
from sqt_jax.types import Array, Environment


class Evaluation(NamedTuple):
    returns: Array  # [episodes]: undiscounted
    lengths: Array  # [episodes]: steps


def evaluate(env: Environment, policy: rollout.Policy, key: Array, num_episodes: int) -> Evaluation:
    """Runs `num_episodes` episodes side by side, each to its own end."""

    def episode_runs(carry):
        _, running, _, _ = carry
        return jnp.any(running)

    def body(carry):
        timestep, running, returns, lengths = carry
        timestep, transition = rollout.step(env, timestep, policy)
        returns = returns + jnp.where(running, transition.reward, 0.0)
        lengths = lengths + running
        return timestep, running & ~(timestep.terminated | timestep.truncated), returns, lengths

    start = rollout.reset(env, key, num_episodes)
    carry = (start, jnp.ones(num_episodes, bool), jnp.zeros(num_episodes), jnp.zeros(num_episodes, jnp.int32))
    _, _, returns, lengths = jax.lax.while_loop(episode_runs, body, carry)
    return Evaluation(returns, lengths)
