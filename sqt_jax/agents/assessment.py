"""TD7's policy checkpoints (https://arxiv.org/abs/2306.02451, section 4.2), in lockstep.

They differ from the paper in one thing: the learner goes on learning while a policy is assessed (one update per step,
so that the members of a sweep stay in lockstep). The policy that acts is therefore a frozen snapshot of the learner,
refreshed when its assessment ends.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax.conditional import cond_if_any
from sqt_jax.config import AgentConfig
from sqt_jax.types import Array, Metrics, Params

# The smallest return of no episodes: finite, so that what is not finite in an agent's state tells of divergence.
NONE = 1e8


class Checkpoints(NamedTuple):
    """The policy that acts, the best one so far, and the assessment under way."""

    snapshot: Params  # acts and is assessed
    checkpoint: Params  # the best assessed: what evaluation uses
    best_min_return: Array  # []: the smallest return of the checkpoint's assessment
    min_return: Array  # []: of the assessment under way
    episodes: Array  # []: of the assessment under way
    assessments: Array  # []: ended so far
    refreshes: Array  # []: times that a snapshot became the checkpoint


def start(policy: Params) -> Checkpoints:
    """Before the first episode: `policy` acts, and any return is better than the best so far."""
    zero = jnp.zeros(())
    return Checkpoints(policy, policy, jnp.float32(-NONE), jnp.float32(NONE), zero, zero, zero)


def assess(
    config: AgentConfig, state: Checkpoints, learner: Params, gradient_steps: Array, episode_return: Array, ended: Array
) -> Checkpoints:
    """Counts an episode of the snapshot and, where that ends its assessment, refreshes checkpoint and snapshot.

    Args:
      learner: what the next snapshot is.
      gradient_steps: []; past `checkpoint_switch`, an assessment expects `assessment_episodes` instead of one.
      episode_return: [], of the episode if it `ended` [] bool; else nothing changes.
    """
    late = gradient_steps >= config.checkpoint_switch
    episodes = state.episodes + 1
    min_return = jnp.minimum(state.min_return, episode_return)
    worse = min_return < state.best_min_return
    better = ~worse & (episodes >= jnp.where(late, config.assessment_episodes, 1))
    over, better = ended & (worse | better), ended & better

    def refresh(policies: tuple[Params, Params], given: tuple[Params, Array]) -> tuple[Params, Params]:
        (snapshot, checkpoint), (learner, better) = policies, given
        return learner, jax.tree.map(lambda a, b: jnp.where(better, a, b), snapshot, checkpoint)

    # Whole networks, and once in an episode: not worth a selection at each step.
    snapshot, checkpoint = cond_if_any(over, refresh, (state.snapshot, state.checkpoint), given=(learner, better))
    return Checkpoints(
        snapshot=snapshot,
        checkpoint=checkpoint,
        best_min_return=jnp.where(better, min_return, state.best_min_return),
        min_return=jnp.where(over, NONE, jnp.where(ended, min_return, state.min_return)),
        episodes=jnp.where(over, 0, jnp.where(ended, episodes, state.episodes)),
        assessments=state.assessments + over,
        refreshes=state.refreshes + better,
    )


def lower_best(config: AgentConfig, state: Checkpoints, gradient_steps: Array) -> Checkpoints:
    """At the switch, once: the best minimum is of one episode, and the minimum of several is harder to reach."""
    at_switch = gradient_steps == config.checkpoint_switch
    lowered = state.best_min_return * config.checkpoint_reset_weight
    return state._replace(best_min_return=jnp.where(at_switch, lowered, state.best_min_return))


def status(state: Checkpoints) -> Metrics:
    """Counts and the best minimum, [] each; NaN before the first refresh."""
    return {
        "assessments": state.assessments,
        "checkpoint_refreshes": state.refreshes,
        "best_min_return": jnp.where(state.refreshes > 0, state.best_min_return, jnp.nan),
    }
