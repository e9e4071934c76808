"""Episodes of a fixed policy from fresh starts."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

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


def evaluate_policy(
    policy: Callable[[Any], Any], env: Any, num_episodes: int = 10, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Plays a policy, such as `load_policy` gives, in any environment with its sizes.

    Args:
      policy: obs [B, O] -> action [B, A] in [-1, 1].
      env: an `Environment` on any physics, or one of Gymnasium's, whose action space is a bounded box and whose
        episodes end (made by `gymnasium.make`, they have a time limit).

    Returns:
      Undiscounted returns [episodes] and lengths [episodes].

    Raises:
      ValueError: a Gymnasium environment's actions have no bounds.
    """
    if isinstance(env, Environment):
        result = jax.jit(lambda key: evaluate(env, policy, key, num_episodes))(jax.random.key(seed))
        return np.asarray(result.returns), np.asarray(result.lengths)
    low, high = env.action_space.low, env.action_space.high
    if not (np.all(np.isfinite(low)) and np.all(np.isfinite(high))):
        raise ValueError(f"an action space with bounds is needed, not {env.action_space}")
    returns, lengths = np.zeros(num_episodes), np.zeros(num_episodes, int)
    for episode in range(num_episodes):
        obs, _ = env.reset(seed=seed + episode)
        over = False
        while not over:
            action = np.clip(policy(np.asarray(obs, np.float32)[None])[0], -1, 1)
            obs, reward, terminated, truncated, _ = env.step(low + (action + 1) / 2 * (high - low))
            returns[episode] += reward
            lengths[episode] += 1
            over = terminated or truncated
    return returns, lengths
