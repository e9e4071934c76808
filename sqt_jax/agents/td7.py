"""TD7 (https://arxiv.org/abs/2306.02451) with N critics and the variant's target.

TD3 with embeddings (SALE), prioritised replay (LAP: the replay is `sqt_jax.lap`), value bounds, hard target copies and
policy checkpoints. The checkpoints differ from the paper in one thing: the learner goes on learning while a policy is
assessed (one update per step, so that the members of a sweep stay in lockstep). The policy that acts is therefore a
frozen snapshot of the learner, refreshed when its assessment ends.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from sqt_jax import losses, sale
from sqt_jax.agents import critic as critics
from sqt_jax.agents.td3 import TD3Noise, make_draw_noise, smooth
from sqt_jax.config import AgentConfig
from sqt_jax.optimizers import adam_init, adam_step
from sqt_jax.types import Agent, Array, Metrics, Params, Scalars, Transition


class ValueBounds(NamedTuple):
    """The smallest and largest targets seen so far, and the pair in use, which clips the next value."""

    running_min: Array  # []
    running_max: Array  # []
    low: Array  # []
    high: Array  # []


class Policy(NamedTuple):
    """What acting needs."""

    actor: Params
    encoder: Params


class Checkpoints(NamedTuple):
    """The policy that acts, the best one so far, and the assessment under way."""

    snapshot: Policy  # acts and is assessed
    checkpoint: Policy  # the best assessed: what evaluation uses
    best_min_return: Array  # []: the smallest return of the checkpoint's assessment
    min_return: Array  # []: of the assessment under way
    episodes: Array  # []: of the assessment under way
    assessments: Array  # []: ended so far
    refreshes: Array  # []: times that a snapshot became the checkpoint


class TD7State(NamedTuple):
    actor: Params
    critic: Params
    encoder: Params
    target_actor: Params
    target_critic: Params
    fixed_encoder: Params
    fixed_encoder_target: Params
    actor_opt: optax.OptState
    critic_opt: optax.OptState
    encoder_opt: optax.OptState
    value_bounds: ValueBounds
    checkpoints: Checkpoints
    scalars: Scalars
    gradient_steps: Array  # [] int32: updates done


def assess(
    config: AgentConfig, state: Checkpoints, learner: Policy, gradient_steps: Array, episode_return: Array, ended: Array
) -> Checkpoints:
    """Counts an episode of the snapshot and, where that ends its assessment, refreshes checkpoint and snapshot.

    Args:
      learner: what the next snapshot is.
      gradient_steps: []; past `checkpoint_switch`, an assessment takes `assessment_episodes` instead of one.
      episode_return: [], of the episode if it `ended` [] bool; else nothing changes.
    """
    late = gradient_steps >= config.checkpoint_switch
    episodes = state.episodes + 1
    min_return = jnp.minimum(state.min_return, episode_return)
    worse = min_return < state.best_min_return
    better = ~worse & (episodes >= jnp.where(late, config.assessment_episodes, 1))
    over, better = ended & (worse | better), ended & better

    def select(condition, new, old):
        return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)

    return Checkpoints(
        snapshot=select(over, learner, state.snapshot),
        checkpoint=select(better, state.snapshot, state.checkpoint),
        best_min_return=jnp.where(better, min_return, state.best_min_return),
        min_return=jnp.where(over, jnp.inf, jnp.where(ended, min_return, state.min_return)),
        episodes=jnp.where(over, 0, jnp.where(ended, episodes, state.episodes)),
        assessments=state.assessments + over,
        refreshes=state.refreshes + better,
    )


def make(config: AgentConfig, observation_size: int, action_size: int) -> Agent:
    encoder_net = sale.encoder(config.embedding_size, config.hidden)
    actor_net = sale.sale_actor(action_size, config.hidden)
    critic_net = sale.sale_critics(config.ensemble_size, config.hidden)
    draw_noise = make_draw_noise(config)

    def init(key: Array, scalars: Scalars | None = None) -> TD7State:
        encoder_key, actor_key, critic_key = jax.random.split(key, 3)
        obs, action = jnp.zeros((1, observation_size)), jnp.zeros((1, action_size))
        z = jnp.zeros((1, config.embedding_size))
        encoder = encoder_net.init(encoder_key, obs, action)
        actor, critic = actor_net.init(actor_key, obs, z), critic_net.init(critic_key, obs, action, z, z)
        bound, zero = jnp.float32(1e8), jnp.zeros(())
        policy = Policy(actor, encoder)
        return TD7State(
            actor=actor,
            critic=critic,
            encoder=encoder,
            target_actor=actor,
            target_critic=critic,
            fixed_encoder=encoder,
            fixed_encoder_target=encoder,
            actor_opt=adam_init(actor),
            critic_opt=adam_init(critic),
            encoder_opt=adam_init(encoder),
            value_bounds=ValueBounds(running_min=bound, running_max=-bound, low=zero, high=zero),
            checkpoints=Checkpoints(policy, policy, -bound, jnp.full((), jnp.inf), zero, zero, zero),
            scalars=(scalars or config.scalars()).as_arrays(),
            gradient_steps=jnp.zeros((), jnp.int32),
        )

    def policy_action(policy: Policy, obs: Array) -> Array:
        return actor_net.apply(policy.actor, obs, encoder_net.zs(policy.encoder, obs))

    def evaluated_policy(state: TD7State) -> Policy:
        return state.checkpoints.checkpoint

    def act(state: TD7State, obs: Array, key: Array, deterministic: bool = False) -> Array:
        if deterministic:
            return policy_action(evaluated_policy(state), obs)
        action = policy_action(state.checkpoints.snapshot, obs)
        return jnp.clip(action + config.exploration_noise * jax.random.normal(key, action.shape), -1.0, 1.0)

    def observe(state: TD7State, episode_return: Array, ended: Array) -> TD7State:
        learner = Policy(state.actor, state.fixed_encoder)
        checkpoints = assess(config, state.checkpoints, learner, state.gradient_steps, episode_return[0], ended[0])
        return state._replace(checkpoints=checkpoints)

    def td_target(state: TD7State, batch: Transition, noise: TD3Noise) -> tuple[Array, dict[str, Array]]:
        zs = encoder_net.zs(state.fixed_encoder_target, batch.next_obs)
        next_action = smooth(actor_net.apply(state.target_actor, batch.next_obs, zs), noise.target_noise, config)
        zsa = encoder_net.zsa(state.fixed_encoder_target, zs, next_action)
        next_q = critic_net.apply(state.target_critic, batch.next_obs, next_action, zsa, zs)
        bounds = (state.value_bounds.low, state.value_bounds.high)
        return critics.td_target(config, state.scalars, batch, next_q, noise.subset, value_bounds=bounds)

    def update_encoder(state: TD7State, batch: Transition) -> tuple[TD7State, Array]:
        def loss_fn(encoder):
            zsa = encoder_net.zsa(encoder, encoder_net.zs(encoder, batch.obs), batch.action)
            return losses.encoder_loss(zsa, encoder_net.zs(encoder, batch.next_obs))

        loss, grads = jax.value_and_grad(loss_fn)(state.encoder)
        encoder, encoder_opt = adam_step(state.encoder, state.encoder_opt, grads, state.scalars.lr)
        return state._replace(encoder=encoder, encoder_opt=encoder_opt), loss

    def update_critic(state: TD7State, batch: Transition, noise: TD3Noise) -> tuple[TD7State, Array, Metrics]:
        target, terms = td_target(state, batch, noise)
        zs = encoder_net.zs(state.fixed_encoder, batch.obs)
        zsa = encoder_net.zsa(state.fixed_encoder, zs, batch.action)
        state, td_error, metrics = critics.update(
            lambda params: critic_net.apply(params, batch.obs, batch.action, zsa, zs),
            lambda q: losses.lap_huber(q, target, config.min_priority),
            config,
            state,
            target,
            terms,
        )
        bounds = state.value_bounds._replace(
            running_min=jnp.minimum(state.value_bounds.running_min, jnp.min(target)),
            running_max=jnp.maximum(state.value_bounds.running_max, jnp.max(target)),
        )
        return state._replace(value_bounds=bounds), td_error, metrics

    def update_actor(state: TD7State, batch: Transition) -> tuple[TD7State, Array]:
        zs = encoder_net.zs(state.fixed_encoder, batch.obs)

        def loss_fn(actor):
            action = actor_net.apply(actor, batch.obs, zs)
            zsa = encoder_net.zsa(state.fixed_encoder, zs, action)
            q = critic_net.apply(state.critic, batch.obs, action, zsa, zs)
            return -jnp.mean(losses.actor_value(q, config.actor_reduce))

        loss, grads = jax.value_and_grad(loss_fn)(state.actor)
        actor, actor_opt = adam_step(state.actor, state.actor_opt, grads, state.scalars.lr)
        return state._replace(actor=actor, actor_opt=actor_opt), loss

    def copy_targets(state: TD7State) -> TD7State:
        bounds = state.value_bounds
        return state._replace(
            target_actor=state.actor,
            target_critic=state.critic,
            fixed_encoder_target=state.fixed_encoder,
            fixed_encoder=state.encoder,
            value_bounds=bounds._replace(low=bounds.running_min, high=bounds.running_max),
        )

    def update_with_noise(state: TD7State, batch: Transition, noise: TD3Noise) -> tuple[TD7State, Array, Metrics]:
        state, encoder_loss = update_encoder(state, batch)
        state, td_error, metrics = update_critic(state, batch, noise)
        gradient_steps = state.gradient_steps + 1
        # Scalars that members share: real branches under vmap.
        actor_due = gradient_steps % config.policy_delay == 0
        copy_due = gradient_steps % config.target_update_period == 0
        not_measured = jnp.full((), jnp.nan)
        state, actor_loss = jax.lax.cond(
            actor_due, update_actor, lambda state, batch: (state, not_measured), state, batch
        )
        state = jax.lax.cond(copy_due, copy_targets, lambda state: state, state)
        best = state.checkpoints.best_min_return
        at_switch = gradient_steps == config.checkpoint_switch
        best = jnp.where(at_switch, best * config.checkpoint_reset_weight, best)
        state = state._replace(
            gradient_steps=gradient_steps, checkpoints=state.checkpoints._replace(best_min_return=best)
        )
        return state, td_error, metrics | {"actor_loss": actor_loss, "encoder_loss": encoder_loss}

    def update(state: TD7State, batch: Transition, key: Array) -> tuple[TD7State, Array, Metrics]:
        return update_with_noise(state, batch, draw_noise(key, batch))

    def status(state: TD7State) -> Metrics:
        checkpoints, bounds = state.checkpoints, state.value_bounds
        return {
            "assessments": checkpoints.assessments,
            "checkpoint_refreshes": checkpoints.refreshes,
            "best_min_return": jnp.where(checkpoints.refreshes > 0, checkpoints.best_min_return, jnp.nan),
            "value_low": bounds.low,
            "value_high": bounds.high,
        }

    return Agent(
        init, act, update, draw_noise, update_with_noise, td_target, evaluated_policy, policy_action, observe, status
    )
