"""TD3 (https://arxiv.org/abs/1802.09477), Algorithm 1, with N critics and the SQT variants' target.

Differs from the paper: the actor maximises the critics' mean (SQT paper, eq. 9), not the first (see BUILD_NOTES.md).
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from sqt_jax import networks, q_targets
from sqt_jax.agents import critic as critics
from sqt_jax.conditional import apply_every
from sqt_jax.config import AgentConfig
from sqt_jax.optimizers import adam_init, adam_step, soft_update
from sqt_jax.types import Array, Metrics, Params, Parts, Scalars, Transition, Views, assemble, not_measured


class TD3State(NamedTuple):
    actor: Params
    critic: Params
    target_actor: Params
    target_critic: Params
    actor_opt: optax.OptState
    critic_opt: optax.OptState
    scalars: Scalars
    diverged: Array  # [] bool: the agent no longer learns (`critic.update`)


class TD3Draws(NamedTuple):
    target_noise: Array  # [B, A], scaled, not yet clipped
    subset: Array  # [M]: critics of the target (all, except in REDQ)


def explore(action: Array, key: Array, config: AgentConfig) -> Array:
    """The action [B, A] with exploration noise, in [-1, 1]."""
    noise = config.exploration_noise * jax.random.normal(key, action.shape)
    return jnp.clip(action + noise, -1.0, 1.0)


def smooth(action: Array, noise: Array, config: AgentConfig) -> Array:
    """Target policy smoothing (TD3 paper, eqs. 14-15): the action [B, A] with clipped noise [B, A], in [-1, 1]."""
    return jnp.clip(action + jnp.clip(noise, -config.target_noise_clip, config.target_noise_clip), -1.0, 1.0)


def draw(key: Array, batch: Transition, config: AgentConfig) -> TD3Draws:
    """Every random number of an update."""
    noise_key, subset_key = jax.random.split(key)
    noise = config.target_noise * jax.random.normal(noise_key, batch.action.shape)
    return TD3Draws(target_noise=noise, subset=critics.draw_subset(subset_key, config))


def build(config: AgentConfig, observation_size: int, action_size: int) -> Parts:
    """TD3 for observations [B, O] and actions [B, A]."""
    actor_net: Any = networks.TanhActor(action_size, config.hidden)
    critic_net = networks.ensemble(networks.Critic, config.ensemble_size, config.hidden, config.layer_norm)

    def init(key: Array, scalars: Scalars | None = None) -> TD3State:
        actor_key, critic_key = jax.random.split(key)
        obs, action = jnp.zeros((1, observation_size)), jnp.zeros((1, action_size))
        actor, critic = actor_net.init(actor_key, obs), critic_net.init(critic_key, obs, action)
        return TD3State(
            actor=actor,
            critic=critic,
            target_actor=actor,
            target_critic=critic,
            actor_opt=adam_init(actor),
            critic_opt=adam_init(critic),
            scalars=(scalars or config.scalars()).as_arrays(),
            diverged=jnp.zeros((), bool),
        )

    def act(state: TD3State, obs: Array, key: Array, deterministic: bool = False) -> Array:
        action = actor_net.apply(state.actor, obs)
        return action if deterministic else explore(action, key, config)

    def td_target(state: TD3State, batch: Transition, draws: TD3Draws) -> tuple[Array, dict[str, Array]]:
        """The minimum over the target critics (TD3 paper, eq. 10), minus the penalty (SQT paper, eqs. 19-20)."""
        next_action = smooth(actor_net.apply(state.target_actor, batch.next_obs), draws.target_noise, config)
        next_q = critic_net.apply(state.target_critic, batch.next_obs, next_action)
        return critics.td_target(config, state, batch, next_q, draws)

    def update_critic(state: TD3State, batch: Transition, draws: TD3Draws) -> tuple[TD3State, Array, Metrics]:
        def q_values(critic):
            return critic_net.apply(critic, batch.obs, batch.action)

        return critics.update(config, state, q_values, *td_target(state, batch, draws))

    def update_actor(state: TD3State, batch: Transition) -> tuple[TD3State, Array]:
        def loss_fn(actor):  # the deterministic policy gradient (TD3 paper, eq. 2)
            q = critic_net.apply(state.critic, batch.obs, actor_net.apply(actor, batch.obs))
            return -jnp.mean(q_targets.ACTOR_REDUCTIONS[config.actor_reduce](q))

        loss, grads = jax.value_and_grad(loss_fn)(state.actor)
        actor, actor_opt, diverged = adam_step(state.actor, state.actor_opt, grads, state.scalars.lr, state.diverged)
        return state._replace(actor=actor, actor_opt=actor_opt, diverged=diverged), loss

    def update_targets(state: TD3State) -> TD3State:
        pairs = (state.target_actor, state.target_critic), (state.actor, state.critic)
        actor, critic = soft_update(*pairs, state.scalars.tau, state.diverged)
        return state._replace(target_actor=actor, target_critic=critic)

    def update(state: TD3State, batch: Transition, draws: TD3Draws, step: Array) -> tuple[TD3State, Array, Metrics]:
        state, td_error, metrics = update_critic(state, batch, draws)

        def delayed(state_and_loss):
            state, actor_loss = update_actor(state_and_loss[0], batch)
            return update_targets(state), actor_loss

        state, actor_loss = apply_every(config.policy_delay, step, delayed, (state, not_measured()))
        return state, td_error, metrics | {"actor_loss": actor_loss}

    views = Views(
        policy=lambda state: state.actor,
        policy_action=actor_net.apply,
        q_values=lambda state, obs, action: critic_net.apply(state.critic, obs, action),
    )
    draw_update = functools.partial(draw, config=config)
    return assemble(init=init, act=act, draw=draw_update, update=update, td_target=td_target, views=views)
