"""SAC (https://arxiv.org/abs/1801.01290) with N critics and the variant's target; temperature fixed or learned."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from sqt_jax import losses, networks
from sqt_jax.agents import critic as critics
from sqt_jax.agents.actions import Actions
from sqt_jax.config import AgentConfig
from sqt_jax.optimizers import adam_init, adam_step, overflows, soft_update
from sqt_jax.types import Agent, Array, Metrics, Params, Scalars, Transition


class SACState(NamedTuple):
    actor: Params
    critic: Params
    target_critic: Params
    log_temperature: Array  # []: 0 and unused where the temperature is fixed
    actor_opt: optax.OptState
    critic_opt: optax.OptState
    temperature_opt: optax.OptState
    scalars: Scalars
    gradient_steps: Array  # [] int32: updates done
    diverged: Array  # [] bool: nothing moves any more (`critic.update`)


class SACNoise(NamedTuple):
    next_action_eps: Array  # [B, A] standard normal: the next action
    action_eps: Array  # [B, A] standard normal: the actor's own action
    subset: Array  # [M]: critics of the target


def actions(config: AgentConfig) -> Actions:
    """SAC's way of acting: samples of a Gaussian squashed by tanh."""

    def greedy(output: networks.Gaussian) -> Array:
        return output.mode()

    def explore(output: networks.Gaussian, key: Array) -> Array:
        return output.sample(jax.random.normal(key, output.mean.shape))[0]

    def draw_noise(key: Array, batch: Transition) -> SACNoise:
        next_key, own_key, subset_key = jax.random.split(key, 3)
        shape = batch.action.shape
        return SACNoise(
            next_action_eps=jax.random.normal(next_key, shape),
            action_eps=jax.random.normal(own_key, shape),
            subset=critics.draw_subset(subset_key, config),
        )

    def next_action(output: networks.Gaussian, noise: SACNoise) -> tuple[Array, Array]:
        return output.sample(noise.next_action_eps, config.squashed_log_prob)

    def own_action(output: networks.Gaussian, noise: SACNoise) -> tuple[Array, Array]:
        return output.sample(noise.action_eps, config.squashed_log_prob)

    return Actions(
        gaussian=True,
        entropy=True,
        greedy=greedy,
        explore=explore,
        draw_noise=draw_noise,
        next_action=next_action,
        own_action=own_action,
    )


def make(config: AgentConfig, observation_size: int, action_size: int) -> Agent:
    """SAC for observations [B, O] and actions [B, A] of these sizes."""
    acting = actions(config)
    actor_net = networks.actor(action_size, config.hidden, acting.gaussian)
    critic_net = networks.critic_ensemble(config.ensemble_size, config.hidden)
    target_entropy = -float(action_size)

    def init(key: Array, scalars: Scalars | None = None) -> SACState:
        actor_key, critic_key = jax.random.split(key)
        obs, action = jnp.zeros((1, observation_size)), jnp.zeros((1, action_size))
        actor = actor_net.init(actor_key, obs)
        critic = critic_net.init(critic_key, obs, action)
        scalars = (scalars or config.scalars()).as_arrays()
        log_temperature = jnp.log(scalars.temperature) if config.learn_temperature else jnp.zeros(())
        return SACState(
            actor=actor,
            critic=critic,
            target_critic=critic,
            log_temperature=log_temperature,
            actor_opt=adam_init(actor),
            critic_opt=adam_init(critic),
            temperature_opt=adam_init(log_temperature),
            scalars=scalars,
            gradient_steps=jnp.zeros((), jnp.int32),
            diverged=jnp.zeros((), bool),
        )

    def policy(state: SACState) -> Params:
        return state.actor

    def policy_action(actor: Params, obs: Array) -> Array:
        return acting.greedy(actor_net.apply(actor, obs))

    def act(state: SACState, obs: Array, key: Array, deterministic: bool = False) -> Array:
        if deterministic:
            return policy_action(policy(state), obs)
        return acting.explore(actor_net.apply(state.actor, obs), key)

    def temperature(state: SACState) -> Array | float:
        return jnp.exp(state.log_temperature) if config.learn_temperature else state.scalars.temperature

    def td_target(state: SACState, batch: Transition, noise: SACNoise) -> tuple[Array, dict[str, Array]]:
        next_action, next_log_prob = acting.next_action(actor_net.apply(state.actor, batch.next_obs), noise)
        next_q = critic_net.apply(state.target_critic, batch.next_obs, next_action)
        entropy_term = temperature(state) * next_log_prob
        target, terms = critics.td_target(config, state.scalars, batch, next_q, noise.subset, entropy_term)
        return target, terms | {"next_log_prob": next_log_prob}

    def update_critic(state: SACState, batch: Transition, noise: SACNoise) -> tuple[SACState, Array, Metrics]:
        target, terms = td_target(state, batch, noise)
        return critics.update_by_squares(critic_net, config, state, batch, target, terms)

    def update_actor(state: SACState, batch: Transition, noise: SACNoise) -> tuple[SACState, Metrics]:
        def loss_fn(actor):
            action, log_prob = acting.own_action(actor_net.apply(actor, batch.obs), noise)
            q = critic_net.apply(state.critic, batch.obs, action)
            return jnp.mean(temperature(state) * log_prob - losses.actor_value(q, config.actor_reduce)), log_prob

        (loss, log_prob), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.actor)
        diverged = state.diverged | overflows(grads)
        actor, actor_opt = adam_step(state.actor, state.actor_opt, grads, state.scalars.lr, diverged)
        metrics = {"actor_loss": loss, "entropy": -jnp.mean(log_prob), "temperature": temperature(state)}
        state = state._replace(actor=actor, actor_opt=actor_opt, diverged=diverged)
        return update_temperature(state, log_prob) if config.learn_temperature else state, metrics

    def update_temperature(state: SACState, log_prob: Array) -> SACState:
        grad = jax.grad(losses.temperature_loss)(state.log_temperature, log_prob, target_entropy)
        diverged = state.diverged | overflows(grad)
        log_temperature, opt = adam_step(state.log_temperature, state.temperature_opt, grad, state.scalars.lr, diverged)
        return state._replace(log_temperature=log_temperature, temperature_opt=opt, diverged=diverged)

    def update_with_noise(state: SACState, batch: Transition, noise: SACNoise) -> tuple[SACState, Array, Metrics]:
        state, td_error, metrics = update_critic(state, batch, noise)
        gradient_steps = state.gradient_steps + 1

        def skip(state, batch, noise):
            return state, dict.fromkeys(("actor_loss", "entropy", "temperature"), jnp.full((), jnp.nan))  # not measured

        due = gradient_steps % config.policy_delay == 0  # a scalar that members share: a real branch under vmap
        state, actor_metrics = jax.lax.cond(due, update_actor, skip, state, batch, noise)
        target_critic = soft_update(state.target_critic, state.critic, state.scalars.tau, state.diverged)
        state = state._replace(target_critic=target_critic, gradient_steps=gradient_steps)
        return state, td_error, metrics | actor_metrics

    def q_values(state: SACState, obs: Array, action: Array) -> Array:
        return critic_net.apply(state.critic, obs, action)

    def valued_act(state: SACState, obs: Array, key: Array) -> tuple[Array, Array]:
        output = actor_net.apply(state.actor, obs)
        action, log_prob = output.sample(jax.random.normal(key, output.mean.shape), config.squashed_log_prob)
        return action, -temperature(state) * log_prob

    def update(state: SACState, batch: Transition, key: Array) -> tuple[SACState, Array, Metrics]:
        return update_with_noise(state, batch, acting.draw_noise(key, batch))

    return Agent(
        init,
        act,
        update,
        acting.draw_noise,
        update_with_noise,
        td_target,
        policy,
        policy_action,
        q_values,
        valued_act,
    )
