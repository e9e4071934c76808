"""TD7's policy checkpoints (https://arxiv.org/abs/2306.02451, section 4.2) around an agent, in lockstep.

They differ from the paper in one point: the learner keeps learning while a policy is assessed (one update per step, so
that the members of a sweep stay in lockstep). The policy that acts is therefore a frozen snapshot of the learner, which
is replaced when its assessment ends.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax.conditional import cond_if_any
from sqt_jax.config import AgentConfig
from sqt_jax.types import Array, Metrics, Params, Parts, Scalars, State, Transition, Views, assemble

# The smallest return of no episodes. Finite: a value in an agent's state that is not finite means divergence.
NO_RETURN = 1e8


class PolicyCheckpoints(NamedTuple):
    """The policy that acts, the best one so far, and the assessment in progress."""

    snapshot: Params  # acts and is assessed
    checkpoint: Params  # the best so far; evaluation plays it
    best_min_return: Array  # []: the smallest return of the checkpoint's assessment
    min_return: Array  # []: the smallest return of the assessment in progress
    episodes: Array  # []: episodes of the assessment in progress
    assessments: Array  # []: finished so far
    refreshes: Array  # []: how often a snapshot became the checkpoint


def start(policy: Params) -> PolicyCheckpoints:
    """Before the first episode: `policy` acts, and any return is better than the best so far."""
    zero = jnp.zeros(())
    return PolicyCheckpoints(
        snapshot=policy,
        checkpoint=policy,
        best_min_return=jnp.float32(-NO_RETURN),
        min_return=jnp.float32(NO_RETURN),
        episodes=zero,
        assessments=zero,
        refreshes=zero,
    )


def assess(
    config: AgentConfig, state: PolicyCheckpoints, learner: Params, step: Array, episode_return: Array, ended: Array
) -> PolicyCheckpoints:
    """Counts an episode of the snapshot. If that ends its assessment, replaces the snapshot and maybe the checkpoint.

    Args:
      learner: the next snapshot.
      step: [] int32, updates done so far. Before `policy_checkpoint_switch` an assessment is one episode, then
        `assessment_episodes`.
      episode_return: [], of the episode if it `ended` [] bool; otherwise nothing changes.
    """
    late = step >= config.policy_checkpoint_switch
    episodes = state.episodes + 1
    min_return = jnp.minimum(state.min_return, episode_return)
    worse = min_return < state.best_min_return
    better = ~worse & (episodes >= jnp.where(late, config.assessment_episodes, 1))
    over, better = ended & (worse | better), ended & better

    def refresh(policies: tuple[Params, Params], given: tuple[Params, Array]) -> tuple[Params, Params]:
        (snapshot, checkpoint), (learner, better) = policies, given
        return learner, jax.tree.map(lambda a, b: jnp.where(better, a, b), snapshot, checkpoint)

    # Complete networks, and once in an episode: not worth a selection at each step.
    snapshot, checkpoint = cond_if_any(over, refresh, (state.snapshot, state.checkpoint), given=(learner, better))
    return PolicyCheckpoints(
        snapshot=snapshot,
        checkpoint=checkpoint,
        best_min_return=jnp.where(better, min_return, state.best_min_return),
        min_return=jnp.where(over, NO_RETURN, jnp.where(ended, min_return, state.min_return)),
        episodes=jnp.where(over, 0, jnp.where(ended, episodes, state.episodes)),
        assessments=state.assessments + over,
        refreshes=state.refreshes + better,
    )


def weight_best(config: AgentConfig, state: PolicyCheckpoints, step: Array) -> PolicyCheckpoints:
    """At the switch, once: multiplies the best minimum by the reset weight, as TD7's code does.

    It is of one episode, and the minimum of several is harder to reach. A positive one becomes easier to reach; a
    negative one moves towards 0, which makes it harder (https://github.com/sfujim/TD7, `train_and_reset` in TD7.py).
    """
    at_switch = step == config.policy_checkpoint_switch
    weighted = state.best_min_return * config.policy_checkpoint_reset_weight
    return state._replace(best_min_return=jnp.where(at_switch, weighted, state.best_min_return))


def status(state: PolicyCheckpoints) -> Metrics:
    """Counts and the best minimum, [] each; NaN before the first refresh."""
    return {
        "assessments": state.assessments,
        "policy_checkpoint_refreshes": state.refreshes,
        "best_min_return": jnp.where(state.refreshes > 0, state.best_min_return, jnp.nan),
    }


class CheckpointedState(NamedTuple):
    """The learner's state and its policy checkpoints."""

    learner: State
    checkpoints: PolicyCheckpoints

    @property
    def scalars(self) -> Scalars:
        return self.learner.scalars

    @property
    def diverged(self) -> Array:
        return self.learner.diverged


def around(config: AgentConfig, learner: Parts, explore: Callable[[Array, Array], Array]) -> Parts:
    """The learner's agent with policy checkpoints: the snapshot acts, the checkpoint is evaluated and saved.

    Args:
      learner: its `views.policy` is assessed.
      explore: (deterministic action [B, A], key) -> action [B, A], how the snapshot acts.
    """
    agent, views = learner.agent, learner.agent.views

    def init(key: Array, scalars: Scalars | None = None) -> CheckpointedState:
        state = agent.init(key, scalars)
        return CheckpointedState(learner=state, checkpoints=start(views.policy(state)))

    def act(state: CheckpointedState, obs: Array, key: Array, deterministic: bool = False) -> Array:
        if deterministic:
            return views.policy_action(state.checkpoints.checkpoint, obs)
        return explore(views.policy_action(state.checkpoints.snapshot, obs), key)

    def update(
        state: CheckpointedState, batch: Transition, draws: Any, step: Array
    ) -> tuple[CheckpointedState, Array, Metrics]:
        learned, td_error, metrics = learner.update(state.learner, batch, draws, step)
        # The barrier: XLA would copy networks that an update does not change at each environment step.
        checkpoints = weight_best(config, jax.lax.optimization_barrier(state.checkpoints), step + 1)
        return CheckpointedState(learner=learned, checkpoints=checkpoints), td_error, metrics

    def observe(state: CheckpointedState, episode_return: Array, ended: Array, step: Array) -> CheckpointedState:
        if episode_return.shape != (1,) or ended.shape != (1,):
            raise ValueError(f"td7 expects one environment: returns and ends of [1], not {episode_return.shape}")
        ended_well = ended[0] & ~state.diverged
        policy = views.policy(state.learner)
        checkpoints = assess(config, state.checkpoints, policy, step, episode_return[0], ended_well)
        return state._replace(checkpoints=checkpoints)

    def see(state: CheckpointedState, obs: Array) -> CheckpointedState:
        return state._replace(learner=agent.see(state.learner, obs))

    return assemble(
        init=init,
        act=act,
        draw=learner.draw,
        update=update,
        td_target=lambda state, batch, draws: learner.td_target(state.learner, batch, draws),
        views=Views(
            policy=lambda state: state.checkpoints.checkpoint,
            policy_action=views.policy_action,
            q_values=lambda state, obs, action: views.q_values(state.learner, obs, action),
            status=lambda state: status(state.checkpoints) | views.status(state.learner),
        ),
        observe=observe,
        see=see,
    )
