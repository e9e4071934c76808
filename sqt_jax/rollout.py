"""One step of a member's E environments under a policy, and the returns and lengths of their episodes."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax.types import Array, Environment, TimeStep, Transition

Policy = Callable[[Array], Array]  # obs [E, O] -> action [E, A]


class Episodes(NamedTuple):
    """Undiscounted returns and lengths of the running episodes, and sums over those that have ended."""

    running_return: Array  # [E]
    running_length: Array  # [E], steps
    ended_return: Array  # []: sum over the episodes that ended since `forget_ended`
    ended_length: Array  # []: sum over these, steps
    ended: Array  # []: their number

    @classmethod
    def start(cls, num_envs: int) -> "Episodes":
        """Before the first step of E = `num_envs` episodes."""
        zeros, zero = jnp.zeros(num_envs), jnp.zeros(())
        return cls(running_return=zeros, running_length=zeros, ended_return=zero, ended_length=zero, ended=zero)

    def add(self, reward: Array, over: Array) -> tuple["Episodes", Array]:
        """One step of each episode.

        Args:
          reward: [E], of the step.
          over: [E] bool, whether the episode ended with the step.

        Returns:
          The new counts, and the returns up to and including this step, [E].
        """
        total, length = self.running_return + reward, self.running_length + 1
        episodes = Episodes(
            running_return=jnp.where(over, 0.0, total),
            running_length=jnp.where(over, 0.0, length),
            ended_return=self.ended_return + jnp.sum(total, where=over),
            ended_length=self.ended_length + jnp.sum(length, where=over),
            ended=self.ended + jnp.sum(over),
        )
        return episodes, total

    def forget_running(self) -> "Episodes":
        """Begin the running episodes again; the sums over ended ones stay."""
        return self._replace(
            running_return=jnp.zeros_like(self.running_return), running_length=jnp.zeros_like(self.running_length)
        )

    def forget_ended(self) -> "Episodes":
        """Reset the sums over ended episodes; the running ones continue."""
        # Three arrays, not one used three times: a buffer can be donated only once.
        return self._replace(
            ended_return=jnp.zeros_like(self.ended_return),
            ended_length=jnp.zeros_like(self.ended_length),
            ended=jnp.zeros_like(self.ended),
        )


def reset(env: Environment, key: Array, num_envs: int) -> TimeStep:
    """The first time steps of E = `num_envs` environments, each with its own key: [E, ...]"""
    return jax.vmap(env.reset)(jax.random.split(key, num_envs))


def step(env: Environment, timestep: TimeStep, policy: Policy) -> tuple[TimeStep, Transition]:
    """One step in each of E environments.

    Args:
      timestep: [E, ...].
      policy: obs [E, O] -> action [E, A].

    Returns:
      The next time steps, and the transitions for the replay: [E, ...] each.
    """
    with jax.named_scope("act"):
        action = policy(timestep.obs)
    with jax.named_scope("environment"):
        following = jax.vmap(env.step)(timestep, action)
    transition = Transition(
        obs=timestep.obs,
        action=action,
        reward=following.reward,
        next_obs=following.final_obs,
        discount=1.0 - following.terminated,
    )
    return following, transition


def uniform_actions(key: Array, num_envs: int, action_size: int) -> Array:
    """Random actions for the warm-up, uniform in [-1, 1]: [E, A]"""
    return jax.random.uniform(key, (num_envs, action_size), minval=-1.0, maxval=1.0)
