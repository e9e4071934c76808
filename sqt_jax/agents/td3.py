"""TD3 (https://arxiv.org/abs/1802.09477) with N critics and the variant's target."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from sqt_jax import losses, networks
from sqt_jax.agents import critic as critics
from sqt_jax.agents.actions import Actions, Output
from sqt_jax.config import AgentConfig
from sqt_jax.optimizers import adam_init, adam_step, overflows, soft_update
from sqt_jax.types import Agent, Array, Metrics, Params, Scalars, Transition


class TD3State(NamedTuple):
    actor: Params
    critic: Params
    target_actor: Params
    target_critic: Params
    actor_opt: optax.OptState
    critic_opt: optax.OptState
    scalars: Scalars
    gradient_steps: Array  # [] int32: updates done
    diverged: Array  # [] bool: nothing moves any more (`critic.update`)


class TD3Noise(NamedTuple):
    target_noise: Array  # [B, A], scaled, not yet clipped
    subset: Array  # [M]: critics of the target
    action_eps: Array | None = None  # [B, A] standard normal: the actor's own action, with `sampled_actor` alone


def smooth(action: Array, noise: Array, config: AgentConfig) -> Array:
    """Target policy smoothing: the action [B, A] with clipped noise [B, A], in [-1, 1]."""
    clipped = jnp.clip(noise, -config.target_noise_clip, config.target_noise_clip)
    return jnp.clip(action + clipped, -1.0, 1.0)


def actions(config: AgentConfig) -> Actions:
    """TD3's way of acting: deterministic, with noise to explore and smoothed in the target.

    With `sampled_actor` the actor is a Gaussian, whose mode acts and which is updated by its samples: what the authors
    of SQT released.
    """

    def greedy(output: Output) -> Array:
        return output.mode() if config.sampled_actor else output

    def explore(output: Output, key: Array) -> Array:
        action = greedy(output)
        noise = config.exploration_noise * jax.random.normal(key, action.shape)
        return jnp.clip(action + noise, -1.0, 1.0)

    def draw_noise(key: Array, batch: Transition) -> TD3Noise:
        noise_key, subset_key, own_key = jax.random.split(key, 3)
        shape = batch.action.shape
        return TD3Noise(
            target_noise=config.target_noise * jax.random.normal(noise_key, shape),
            subset=critics.draw_subset(subset_key, config),
            action_eps=jax.random.normal(own_key, shape) if config.sampled_actor else None,
        )

    def next_action(output: Output, noise: TD3Noise) -> tuple[Array, Array]:
        return smooth(greedy(output), noise.target_noise, config), jnp.zeros(())

    def own_action(output: Output, noise: TD3Noise) -> tuple[Array, Array]:
        return output.sample(noise.action_eps)[0] if config.sampled_actor else output, jnp.zeros(())

    return Actions(
        gaussian=config.sampled_actor,
        entropy=False,
        greedy=greedy,
        explore=explore,
        draw_noise=draw_noise,
        next_action=next_action,
        own_action=own_action,
    )


def make(config: AgentConfig, observation_size: int, action_size: int) -> Agent:
    """TD3 for observations [B, O] and actions [B, A] of these sizes."""
    acting = actions(config)
    actor_net = networks.actor(action_size, config.hidden, acting.gaussian)
    critic_net = networks.critic_ensemble(config.ensemble_size, config.hidden)

    def init(key: Array, scalars: Scalars | None = None) -> TD3State:
        actor_key, critic_key = jax.random.split(key)
        obs, action = jnp.zeros((1, observation_size)), jnp.zeros((1, action_size))
        actor = actor_net.init(actor_key, obs)
        critic = critic_net.init(critic_key, obs, action)
        return TD3State(
            actor=actor,
            critic=critic,
            target_actor=actor,
            target_critic=critic,
            actor_opt=adam_init(actor),
            critic_opt=adam_init(critic),
            scalars=(scalars or config.scalars()).as_arrays(),
            gradient_steps=jnp.zeros((), jnp.int32),
            diverged=jnp.zeros((), bool),
        )

    def policy(state: TD3State) -> Params:
        return state.actor

    def policy_action(actor: Params, obs: Array) -> Array:
        return acting.greedy(actor_net.apply(actor, obs))

    def act(state: TD3State, obs: Array, key: Array, deterministic: bool = False) -> Array:
        if deterministic:
            return policy_action(policy(state), obs)
        return acting.explore(actor_net.apply(state.actor, obs), key)

    def td_target(state: TD3State, batch: Transition, noise: TD3Noise) -> tuple[Array, dict[str, Array]]:
        next_action, _ = acting.next_action(actor_net.apply(state.target_actor, batch.next_obs), noise)
        next_q = critic_net.apply(state.target_critic, batch.next_obs, next_action)
        return critics.td_target(config, state.scalars, batch, next_q, noise.subset)

    def update_critic(state: TD3State, batch: Transition, noise: TD3Noise) -> tuple[TD3State, Array, Metrics]:
        target, terms = td_target(state, batch, noise)
        return critics.update_by_squares(critic_net, config, state, batch, target, terms)

    def update_actor(state: TD3State, batch: Transition, noise: TD3Noise) -> tuple[TD3State, Array]:
        def loss_fn(actor):
            action, _ = acting.own_action(actor_net.apply(actor, batch.obs), noise)
            q = critic_net.apply(state.critic, batch.obs, action)
            return -jnp.mean(losses.actor_value(q, config.actor_reduce))

        loss, grads = jax.value_and_grad(loss_fn)(state.actor)
        diverged = state.diverged | overflows(grads)
        actor, actor_opt = adam_step(state.actor, state.actor_opt, grads, state.scalars.lr, diverged)
        return state._replace(actor=actor, actor_opt=actor_opt, diverged=diverged), loss

    def update_targets(state: TD3State) -> TD3State:
        tau = state.scalars.tau
        return state._replace(
            target_actor=soft_update(state.target_actor, state.actor, tau, state.diverged),
            target_critic=soft_update(state.target_critic, state.critic, tau, state.diverged),
        )

    def update_with_noise(state: TD3State, batch: Transition, noise: TD3Noise) -> tuple[TD3State, Array, Metrics]:
        state, td_error, metrics = update_critic(state, batch, noise)
        gradient_steps = state.gradient_steps + 1

        def delayed(state):
            state, actor_loss = update_actor(state, batch, noise)
            return update_targets(state), actor_loss

        def skip(state):
            return state, jnp.full((), jnp.nan)  # not measured

        due = gradient_steps % config.policy_delay == 0  # a scalar that members share: a real branch under vmap
        state, actor_loss = jax.lax.cond(due, delayed, skip, state)
        return state._replace(gradient_steps=gradient_steps), td_error, metrics | {"actor_loss": actor_loss}

    def q_values(state: TD3State, obs: Array, action: Array) -> Array:
        return critic_net.apply(state.critic, obs, action)

    def update(state: TD3State, batch: Transition, key: Array) -> tuple[TD3State, Array, Metrics]:
        return update_with_noise(state, batch, acting.draw_noise(key, batch))

    return Agent(init, act, update, acting.draw_noise, update_with_noise, td_target, policy, policy_action, q_values)
