"""SAC (https://arxiv.org/abs/1812.05905), Algorithm 1, with N critics and the SQT variants' target.

Temperature fixed (https://arxiv.org/abs/1801.01290) or learned. Differs from the paper: the actor maximises the mean of
the critics (SQT paper, eq. 9), not the minimum; see BUILD_NOTES.md.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from sqt_jax import networks, q_targets
from sqt_jax.agents import critic as critics
from sqt_jax.conditional import apply_every
from sqt_jax.config import AgentConfig
from sqt_jax.gaussian import gaussian_actor
from sqt_jax.optimizers import adam_init, adam_step, soft_update
from sqt_jax.types import Array, Metrics, Params, Parts, Scalars, Transition, Views, assemble, not_measured


class SACState(NamedTuple):
    actor: Params
    critic: Params
    target_critic: Params
    log_temperature: Array  # []: 0 and unused where the temperature is fixed
    actor_opt: optax.OptState
    critic_opt: optax.OptState
    temperature_opt: optax.OptState
    scalars: Scalars
    diverged: Array  # [] bool: the agent no longer learns (`critic.update`)


class SACDraws(NamedTuple):
    next_action_eps: Array  # [B, A] standard normal: the next action
    action_eps: Array  # [B, A] standard normal: the action of the actor's update
    subset: Array  # [M]: critics of the target


def draw(key: Array, batch: Transition, config: AgentConfig) -> SACDraws:
    """Every random number of an update."""
    next_key, action_key, subset_key = jax.random.split(key, 3)
    return SACDraws(
        next_action_eps=jax.random.normal(next_key, batch.action.shape),
        action_eps=jax.random.normal(action_key, batch.action.shape),
        subset=critics.draw_subset(subset_key, config),
    )


def temperature_loss(log_temperature: Array, log_prob: Array, target_entropy: float) -> Array:
    """The dual loss of the temperature (SAC paper, eq. 18): log_prob [B] -> []."""
    return -jnp.exp(log_temperature) * jnp.mean(log_prob + target_entropy)


def build(config: AgentConfig, observation_size: int, action_size: int) -> Parts:
    """SAC for observations [B, O] and actions [B, A]."""
    actor_net = gaussian_actor(action_size, config.hidden)
    critic_net = networks.ensemble(networks.Critic, config.ensemble_size, config.hidden, config.layer_norm)
    target_entropy = -float(action_size)

    def init(key: Array, scalars: Scalars | None = None) -> SACState:
        actor_key, critic_key = jax.random.split(key)
        obs, action = jnp.zeros((1, observation_size)), jnp.zeros((1, action_size))
        actor, critic = actor_net.init(actor_key, obs), critic_net.init(critic_key, obs, action)
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
            diverged=jnp.zeros((), bool),
        )

    def temperature(state: SACState) -> Array | float:
        return jnp.exp(state.log_temperature) if config.learn_temperature else state.scalars.temperature

    def policy_action(actor: Params, obs: Array) -> Array:
        return actor_net.apply(actor, obs).mode()

    def sample(state: SACState, obs: Array, key: Array) -> tuple[Array, Array]:
        """A sampled action [B, A] and its log-probability [B]."""
        gaussian = actor_net.apply(state.actor, obs)
        return gaussian.sample(jax.random.normal(key, gaussian.mean.shape))

    def act(state: SACState, obs: Array, key: Array, deterministic: bool = False) -> Array:
        return policy_action(state.actor, obs) if deterministic else sample(state, obs, key)[0]

    def td_target(state: SACState, batch: Transition, draws: SACDraws) -> tuple[Array, dict[str, Array]]:
        """The soft value of the current actor (SAC paper, eqs. 3, 5), minus the penalty (SQT paper, eqs. 19-20)."""
        next_action, next_log_prob = actor_net.apply(state.actor, batch.next_obs).sample(draws.next_action_eps)
        next_q = critic_net.apply(state.target_critic, batch.next_obs, next_action)
        entropy_term = temperature(state) * next_log_prob
        target, terms = critics.td_target(config, state, batch, next_q, draws, entropy_term=entropy_term)
        return target, terms | {"next_log_prob": next_log_prob}

    def update_critic(state: SACState, batch: Transition, draws: SACDraws) -> tuple[SACState, Array, Metrics]:
        def q_values(critic):
            return critic_net.apply(critic, batch.obs, batch.action)

        return critics.update(config, state, q_values, *td_target(state, batch, draws))

    def update_actor(state: SACState, batch: Transition, draws: SACDraws) -> tuple[SACState, Metrics]:
        """The reparametrised policy loss (SAC paper, eq. 9), and the temperature's step where it is learned."""

        def loss_fn(actor):
            action, log_prob = actor_net.apply(actor, batch.obs).sample(draws.action_eps)
            value = q_targets.ACTOR_REDUCTIONS[config.actor_reduce](critic_net.apply(state.critic, batch.obs, action))
            return jnp.mean(temperature(state) * log_prob - value), log_prob

        (loss, log_prob), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.actor)
        actor, actor_opt, diverged = adam_step(state.actor, state.actor_opt, grads, state.scalars.lr, state.diverged)
        metrics = {"actor_loss": loss, "entropy": -jnp.mean(log_prob), "temperature": temperature(state)}
        state = state._replace(actor=actor, actor_opt=actor_opt, diverged=diverged)
        return update_temperature(state, log_prob) if config.learn_temperature else state, metrics

    def update_temperature(state: SACState, log_prob: Array) -> SACState:
        grad = jax.grad(temperature_loss)(state.log_temperature, log_prob, target_entropy)
        log_temperature, opt, diverged = adam_step(
            state.log_temperature, state.temperature_opt, grad, state.scalars.lr, state.diverged
        )
        return state._replace(log_temperature=log_temperature, temperature_opt=opt, diverged=diverged)

    def update(state: SACState, batch: Transition, draws: SACDraws, step: Array) -> tuple[SACState, Array, Metrics]:
        state, td_error, metrics = update_critic(state, batch, draws)

        def delayed(state_and_metrics):
            return update_actor(state_and_metrics[0], batch, draws)

        skipped = dict.fromkeys(("actor_loss", "entropy", "temperature"), not_measured())
        state, actor_metrics = apply_every(config.policy_delay, step, delayed, (state, skipped))
        target_critic = soft_update(state.target_critic, state.critic, state.scalars.tau, state.diverged)
        return state._replace(target_critic=target_critic), td_error, metrics | actor_metrics

    def sample_with_bonus(state: SACState, obs: Array, key: Array) -> tuple[Array, Array]:
        action, log_prob = sample(state, obs, key)
        return action, -temperature(state) * log_prob

    views = Views(
        policy=lambda state: state.actor,
        policy_action=policy_action,
        q_values=lambda state, obs, action: critic_net.apply(state.critic, obs, action),
        sample=sample_with_bonus,
    )
    draw_update = functools.partial(draw, config=config)
    return assemble(init=init, act=act, draw=draw_update, update=update, td_target=td_target, views=views)
