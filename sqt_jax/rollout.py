"""One lockstep step of a member's E environments under a policy, and the bookkeeping of its episodes."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax.types import Array, Environment, TimeStep, Transition

Policy = Callable[[Array], Array]  # obs [E, O] -> action [E, A]


class Episodes(NamedTuple):
    """Undiscounted returns and lengths of the running episodes, and sums over those that ended."""

    running_return: Array  # [E]
    running_length: Array  # [E]
    ended_return: Array  # []: sum
    ended_length: Array  # []: sum
    ended: Array  # []: count

    @classmethod
    def start(cls, num_envs: int) -> "Episodes":
        zeros, zero = jnp.zeros(num_envs), jnp.zeros(())
        return cls(zeros, zeros, zero, zero, zero)

    def add(self, reward: Array, over: Array) -> tuple["Episodes", Array]:
        """Takes reward [E] and over [E] bool (the episodes that end with it); gives the returns up to here too, [E]."""
        total, length = self.running_return + reward, self.running_length + 1
        episodes = Episodes(
            running_return=jnp.where(over, 0.0, total),
            running_length=jnp.where(over, 0.0, length),
            ended_return=self.ended_return + jnp.sum(total, where=over),
            ended_length=self.ended_length + jnp.sum(length, where=over),
            ended=self.ended + jnp.sum(over),
        )
        return episodes, total

    def forget_ended(self) -> "Episodes":
        """The sums begin anew, the running episodes go on."""
        # An array each: a buffer can be donated once only.
        return self._replace(
            ended_return=jnp.zeros_like(self.ended_return),
            ended_length=jnp.zeros_like(self.ended_length),
            ended=jnp.zeros_like(self.ended),
        )


def reset(env: Environment, key: Array, num_envs: int) -> TimeStep:
    """First time steps of `num_envs` environments, [E, ...]."""
    return jax.vmap(env.reset)(jax.random.split(key, num_envs))


def step(env: Environment, timestep: TimeStep, policy: Policy) -> tuple[TimeStep, Transition]:
    """Acts once in each of E environments and gives what the replay stores of it, [E, ...]."""
    action = policy(timestep.obs)
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
    """The warm-up's actions, uniform in [-1, 1]: [E, A]"""
    return jax.random.uniform(key, (num_envs, action_size), minval=-1.0, maxval=1.0)
