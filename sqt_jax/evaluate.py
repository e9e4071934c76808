"""Evaluation: episodes of a fixed policy from fresh starts, and the bias of its critics along them."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from sqt_jax import rollout
from sqt_jax.bias import BiasSums
from sqt_jax.conditional import any_in_batch
from sqt_jax.types import Array, Environment, Metrics, Transition

PolicyWithBonus = Callable[[Array, Array], tuple[Array, Array]]  # obs [E, O], key -> action [E, A], entropy bonus [E]
Critics = Callable[[Array, Array], Array]  # obs [K, O], action [K, A] -> [N, K]
Extra = TypeVar("Extra")


class Evaluation(NamedTuple):
    """The results of some episodes: [episodes] each."""

    returns: Array  # undiscounted
    lengths: Array  # int32: steps
    # Mean forward speed over the steps, m/s. The step that ends the episode is left out: the state after it is the
    # start of the next episode. NaN if the environment has no `speed`, or the episode only one step.
    speeds: Array


def evaluate(env: Environment, policy: rollout.Policy, key: Array, num_episodes: int) -> Evaluation:
    """Play episodes in parallel, each until its own end.

    Args:
      policy: obs [E, O] -> action [E, A], with E = `num_episodes`.
      key: draws the starts.
    """
    return _play(env, lambda obs, key: (policy(obs), None), key, num_episodes, None, lambda extra, step: extra)[0]


def evaluate_with_bias(
    env: Environment,
    policy: PolicyWithBonus,
    critics: Critics,
    gamma: Array,
    key: Array,
    num_episodes: int,
    num_bias_episodes: int,
) -> tuple[Evaluation, Metrics]:
    """`evaluate`, and the bias of the critics along the last `num_bias_episodes` episodes.

    Args:
      policy: obs [E, O], key -> action [E, A] and its entropy bonus [E] (0 without an entropy term), with E =
        `num_episodes`.
      critics: obs [K, O], action [K, A] -> [N, K], with K = `num_bias_episodes`.
      gamma: [], the discount factor of the critics.
      key: draws the starts and the policy's keys.

    Returns:
      All episodes' results, and the metrics `bias.NAMES` ([] each, see `BiasSums.result`).
    """

    def add(extra: tuple[BiasSums, Array], step: _Step) -> tuple[BiasSums, Array]:
        sums, terminated = extra
        transition = jax.tree.map(lambda x: x[-num_bias_episodes:], step.transition)
        running, bonus = step.running[-num_bias_episodes:], step.bonus[-num_bias_episodes:]
        q = critics(transition.obs, transition.action)
        sums = sums.add(running, env.episode_length - step.number, transition.reward, bonus, q, gamma)
        return sums, terminated | (running & (transition.discount == 0))

    extra = BiasSums.start(num_bias_episodes), jnp.zeros(num_bias_episodes, bool)
    evaluation, (sums, terminated) = _play(env, policy, key, num_episodes, extra, add)
    return evaluation, sums.result(terminated)


class _Step(NamedTuple):
    number: Array  # [] int32: steps before this one, the same in all episodes
    running: Array  # [E] bool: whether the episode had not ended before this step
    transition: Transition  # [E, ...]
    bonus: Any  # the policy's second output


def _play(
    env: Environment,
    policy: Callable[[Array, Array], tuple[Array, Any]],
    key: Array,
    num_episodes: int,
    extra: Extra,
    add: Callable[[Extra, _Step], Extra],
) -> tuple[Evaluation, Extra]:
    """Play episodes in parallel; `extra` is updated by `add(extra, step)` at each step."""

    # `rollout.reset` splits `key` into the episodes' keys; the policy needs different ones.
    policy_key = jax.random.fold_in(key, 2**31)

    def any_running(carry):
        running = jnp.any(carry[2])
        # On the host one call steps the environments of all members: none may stop before the others.
        return any_in_batch(running) if env.host else running

    def body(carry):
        number, timestep, running, (returns, lengths, speed_sums), extra = carry
        action, bonus = policy(timestep.obs, jax.random.fold_in(policy_key, number))
        timestep, transition = rollout.step(env, timestep, lambda obs: action)
        extra = add(extra, _Step(number=number, running=running, transition=transition, bonus=bonus))
        returns += jnp.where(running, transition.reward, 0.0)
        lengths += running
        running &= ~(timestep.terminated | timestep.truncated)
        if env.speed:
            speed_sums += jnp.where(running, jax.vmap(env.speed)(timestep), 0.0)
        return number + 1, timestep, running, (returns, lengths, speed_sums), extra

    totals = jnp.zeros(num_episodes), jnp.zeros(num_episodes, jnp.int32), jnp.zeros(num_episodes)
    start = rollout.reset(env, key, num_episodes)
    carry = (jnp.zeros((), jnp.int32), start, jnp.ones(num_episodes, bool), totals, extra)
    *_, (returns, lengths, speed_sums), extra = jax.lax.while_loop(any_running, body, carry)
    counted = lengths - 1 if env.speed else jnp.zeros_like(lengths)
    speeds = jnp.where(counted > 0, speed_sums / jnp.maximum(counted, 1), jnp.nan)
    return Evaluation(returns=returns, lengths=lengths, speeds=speeds), extra


def evaluate_policy(
    policy: Callable[[Any], Any], env: Any, num_episodes: int = 10, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Play a policy (for example from `load_policy`) in an environment with its observation and action sizes.

    Args:
      policy: obs [B, O] -> action [B, A] in [-1, 1]. With an `Environment` it is traced, so it has to be JAX code.
      env: an `Environment`, or a Gymnasium environment with a bounded box as its action space and episodes that end
        (those of `gymnasium.make` have a time limit). Its observations are flattened, its actions scaled, by
        `envs.gym_spaces`.
      num_episodes: episodes to play.
      seed: of the starts; Gymnasium's episode k starts with `reset(seed=seed + k)`.

    Returns:
      Undiscounted returns [episodes] and lengths [episodes], in steps.

    Raises:
      ValueError: the policy's actions have another size than the environment's. With a Gymnasium environment also:
        an action is NaN, or `envs.gym_spaces` rejects a space.
      RuntimeError: an environment on the host (`gym:ID`) raised an exception.
    """
    if isinstance(env, Environment):
        checked = _checked(policy, env.action_size)
        result = jax.jit(lambda key: evaluate(env, checked, key, num_episodes))(jax.random.key(seed))
        returns, lengths = np.asarray(result.returns), np.asarray(result.lengths)
        if env.host and (error := env.host.error()):
            raise RuntimeError(f"{env.name}: {error.text}\n{error.traceback}")
        return returns, lengths
    from sqt_jax.envs import gym_spaces  # imports gymnasium, which environments in JAX do not need

    observations, actions = gym_spaces.observations(env.observation_space), gym_spaces.actions(env.action_space)
    checked = _checked(policy, actions.size)
    returns, lengths = np.zeros(num_episodes), np.zeros(num_episodes, int)
    for episode in range(num_episodes):
        obs, _ = env.reset(seed=seed + episode)
        over = False
        while not over:
            action = actions.scale(checked(observations.flatten(obs)[None])[0])
            obs, reward, terminated, truncated, _ = env.step(action)
            returns[episode] += reward
            lengths[episode] += 1
            over = terminated or truncated
    return returns, lengths


def _checked(policy: Callable[[Any], Any], action_size: int) -> Callable[[Any], Any]:
    """The policy, with a ValueError if its actions for obs [B, O] are not [B, `action_size`]."""

    def act(obs: Any) -> Any:
        action = policy(obs)
        if np.shape(action) != (len(obs), action_size):
            expected = f"[{len(obs)}, {action_size}] for observations {list(obs.shape)}"
            raise ValueError(f"policy: expects actions {expected}, not {list(np.shape(action))}")
        return action

    return act
