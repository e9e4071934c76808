"""Episodes of a fixed policy from fresh starts: what it reaches, and what its critics say of that."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from sqt_jax import rollout
from sqt_jax.bias import Judgement
from sqt_jax.types import Array, Environment, Metrics, Transition

JudgedPolicy = Callable[[Array, Array], tuple[Array, Array]]  # obs [E, O], key -> action [E, A], entropy bonus [E]
Critics = Callable[[Array, Array], Array]  # obs [E, O], action [E, A] -> [N, E]
Seen = TypeVar("Seen")


class Evaluation(NamedTuple):
    returns: Array  # [episodes]: undiscounted
    lengths: Array  # [episodes]: steps


def evaluate(env: Environment, policy: rollout.Policy, key: Array, num_episodes: int) -> Evaluation:
    """Runs `num_episodes` episodes side by side, each to its own end."""

    return _play(env, lambda obs, key: (policy(obs), None), key, num_episodes, None, lambda seen, step: seen)[0]


def evaluate_and_judge(
    env: Environment, policy: JudgedPolicy, critics: Critics, gamma: Array, key: Array, num_episodes: int, judged: int
) -> tuple[Evaluation, Metrics]:
    """`evaluate`, and the bias of the critics' values along the last `judged` of the episodes (`bias.Judgement`)."""

    def watch(seen: tuple[Judgement, Array], step: _Step) -> tuple[Judgement, Array]:
        judgement, terminated = seen
        transition = jax.tree.map(lambda x: x[-judged:], step.transition)
        running, bonus = step.running[-judged:], step.bonus[-judged:]
        q = critics(transition.obs, transition.action)
        steps_left = env.episode_length - step.number
        judgement = judgement.add(running, steps_left, transition.reward, bonus, q, gamma)
        return judgement, terminated | (running & (transition.discount == 0))

    seen = Judgement.start(judged), jnp.zeros(judged, bool)
    evaluation, (judgement, terminated) = _play(env, policy, key, num_episodes, seen, watch)
    return evaluation, judgement.result(terminated)


class _Step(NamedTuple):
    number: Array  # [] int32, of the episodes, from 0
    running: Array  # [E] bool: whether the episode was still going on before it
    transition: Transition  # [E, ...]
    bonus: Any  # what the policy gave beside the action


def _play(
    env: Environment,
    policy: Callable[[Array, Array], tuple[Array, Any]],
    key: Array,
    num_episodes: int,
    seen: Seen,
    watch: Callable[[Seen, _Step], Seen],
) -> tuple[Evaluation, Seen]:
    """Episodes side by side; `seen` is what `watch` makes of each of their steps."""

    # `reset` makes the episodes' keys of `key` by their small numbers: the policy's have to be others.
    policy_key = jax.random.fold_in(key, 2**31)

    def episode_runs(carry):
        return jnp.any(carry[2])

    def body(carry):
        number, timestep, running, evaluation, seen = carry
        action, bonus = policy(timestep.obs, jax.random.fold_in(policy_key, number))
        timestep, transition = rollout.step(env, timestep, lambda obs: action)
        seen = watch(seen, _Step(number, running, transition, bonus))
        evaluation = Evaluation(
            returns=evaluation.returns + jnp.where(running, transition.reward, 0.0),
            lengths=evaluation.lengths + running,
        )
        return number + 1, timestep, running & ~(timestep.terminated | timestep.truncated), evaluation, seen

    nothing = Evaluation(jnp.zeros(num_episodes), jnp.zeros(num_episodes, jnp.int32))
    start = rollout.reset(env, key, num_episodes)
    carry = (jnp.zeros((), jnp.int32), start, jnp.ones(num_episodes, bool), nothing, seen)
    *_, evaluation, seen = jax.lax.while_loop(episode_runs, body, carry)
    return evaluation, seen


def evaluate_policy(
    policy: Callable[[Any], Any], env: Any, num_episodes: int = 10, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Plays a policy, such as `load_policy` gives, in any environment with its sizes.

    Args:
      policy: obs [B, O] -> action [B, A] in [-1, 1]; with an `Environment` it is traced, and has to be JAX code.
      env: an `Environment` on any physics, or one of Gymnasium's, whose action space is a bounded box and whose
        episodes end (made by `gymnasium.make`, they have a time limit).
      seed: of all the starts; Gymnasium's episode k expects `seed + k`.

    Returns:
      Undiscounted returns [episodes] and lengths [episodes].

    Raises:
      ValueError: a Gymnasium environment's actions have no bounds.
    """
    if isinstance(env, Environment):
        result = jax.jit(lambda key: evaluate(env, policy, key, num_episodes))(jax.random.key(seed))
        return np.asarray(result.returns), np.asarray(result.lengths)
    low, high = (getattr(env.action_space, side, np.inf) for side in ("low", "high"))
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
