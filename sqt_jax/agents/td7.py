"""TD7 (https://arxiv.org/abs/2306.02451), appendix A, Algorithm 1, with N critics and the SQT variants' target.

TD3 plus four additions: embeddings (SALE, section 4.1: `sqt_jax.sale`), prioritised replay (LAP: `sqt_jax.lap`),
clipped values with hard target copies, and policy checkpoints (section 4.2: `policy_checkpoints`, which names the one
difference from the paper).
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from sqt_jax import q_targets, sale, trees
from sqt_jax.agents import critic as critics
from sqt_jax.agents import normalised, policy_checkpoints, td3
from sqt_jax.conditional import apply_every
from sqt_jax.config import AgentConfig
from sqt_jax.optimizers import adam_init, adam_step
from sqt_jax.types import Array, Metrics, Params, Parts, Scalars, Transition, Views, assemble, not_measured

UNBOUNDED = 1e30  # far beyond `critic.LARGEST_VALUE`, and finite


class ActionRules(NamedTuple):
    """How the output of an actor network becomes actions [B, A]. TD7 has TD3's rules, `released` others.

    An entropy term is [B], or 0.0 without one.
    """

    gaussian: bool  # whether the actor outputs a `Gaussian` or an action
    mode: Callable[[Any], Array]  # output -> the deterministic action
    explore: Callable[[Any, Array], Array]  # (output, key) -> the action in the environment
    draw: Callable[[Array, Transition], Any]  # (key, batch) -> every random number of an update, with a `subset`
    next_action: Callable[[Any, Any, Scalars], tuple[Array, Any]]  # (output, draws, scalars) -> a', entropy term
    # The same for the actor's update, with metrics.
    actor_action: Callable[[Any, Any, Scalars], tuple[Array, Any, Metrics]]
    # With an entropy term: (output, key, scalars) -> a sampled action, its entropy bonus [B].
    sample: Callable[[Any, Array, Scalars], tuple[Array, Array]] | None = None


def deterministic(config: AgentConfig) -> ActionRules:
    """TD3's rules: noise to explore, a smoothed next action, the actor's own action in its update."""
    return ActionRules(
        gaussian=False,
        mode=lambda action: action,
        explore=functools.partial(td3.explore, config=config),
        draw=functools.partial(td3.draw, config=config),
        next_action=lambda action, draws, scalars: (td3.smooth(action, draws.target_noise, config), 0.0),
        actor_action=lambda action, draws, scalars: (action, 0.0, {}),
    )


class ValueBounds(NamedTuple):
    """The smallest and largest targets so far, and the pair in use, which clips the next value."""

    running_min: Array  # []
    running_max: Array  # []
    low: Array  # []
    high: Array  # []

    @classmethod
    def start(cls) -> "ValueBounds":
        bound, zero = jnp.float32(1e8), jnp.zeros(())
        return cls(running_min=bound, running_max=-bound, low=zero, high=zero)

    @classmethod
    def unbounded(cls) -> "ValueBounds":
        """Bounds that never clip and never change."""
        bound = jnp.float32(UNBOUNDED)
        return cls(running_min=-bound, running_max=bound, low=-bound, high=bound)

    def track(self, target: Array) -> "ValueBounds":
        return self._replace(
            running_min=jnp.minimum(self.running_min, jnp.min(target)),
            running_max=jnp.maximum(self.running_max, jnp.max(target)),
        )

    def put_in_use(self) -> "ValueBounds":
        return self._replace(low=self.running_min, high=self.running_max)


class PolicyParams(NamedTuple):
    """The parameters that acting needs."""

    actor: Params
    encoder: Params


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
    scalars: Scalars
    diverged: Array  # [] bool: the agent no longer learns (`critic.update`)


def encoder_loss(zsa: Array, next_zs: Array) -> Array:
    """How far zsa [B, Z] is from the next observation's zs [B, Z], which gets no gradient (TD7 paper, eq. 2): -> []."""
    return jnp.mean((zsa - jax.lax.stop_gradient(next_zs)) ** 2)


def lap_huber(q: Array, td_target: Array, min_priority: float) -> Array:
    """LAP's Huber loss, summed over critics, averaged over the batch: q [N, B], td_target [B] -> [].

    Quadratic below `min_priority`, linear above, where LAP's sampling compensates for the smaller slope
    (https://arxiv.org/abs/2007.06049, section 5).
    """
    error = jnp.abs(q - td_target)
    return jnp.sum(jnp.mean(jnp.where(error < min_priority, 0.5 * error**2, min_priority * error), axis=-1))


def build(config: AgentConfig, observation_size: int, action_size: int) -> Parts:
    """TD7 for observations [B, O] and actions [B, A]: the learner below with policy checkpoints."""
    learner = build_learner(config, observation_size, action_size, deterministic(config))
    return with_checkpoints(config, learner, observation_size)


def with_checkpoints(config: AgentConfig, learner: Parts, observation_size: int) -> Parts:
    """The learner, its observations normalised if they are to be, with policy checkpoints around it.

    In this order, so that snapshot and checkpoint keep the moments that they were made with.
    """
    if config.normalize_observations:
        learner = normalised.around(learner, observation_size)
    return policy_checkpoints.around(config, learner, functools.partial(td3.explore, config=config))


def build_learner(
    config: AgentConfig,
    observation_size: int,
    action_size: int,
    rules: ActionRules,
    train_encoder: bool = True,
    clip_values: bool = True,
) -> Parts:
    """TD7 without policy checkpoints, and with any `rules`."""
    encoder_net = sale.encoder(config.embedding_size, config.hidden)
    actor_net = sale.sale_actor(action_size, config.hidden, rules.gaussian)
    critic_net = sale.sale_critics(config.ensemble_size, config.hidden)

    def init(key: Array, scalars: Scalars | None = None) -> TD7State:
        encoder_key, actor_key, critic_key = jax.random.split(key, 3)
        obs, action = jnp.zeros((1, observation_size)), jnp.zeros((1, action_size))
        z = jnp.zeros((1, config.embedding_size))
        encoder = encoder_net.init(encoder_key, obs, action)
        actor, critic = actor_net.init(actor_key, obs, z), critic_net.init(critic_key, obs, action, z, z)
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
            value_bounds=ValueBounds.start() if clip_values else ValueBounds.unbounded(),
            scalars=(scalars or config.scalars()).as_arrays(),
            diverged=jnp.zeros((), bool),
        )

    def policy(state: TD7State) -> PolicyParams:
        return PolicyParams(actor=state.actor, encoder=state.fixed_encoder)

    def output(policy: PolicyParams, obs: Array) -> Any:
        return actor_net.apply(policy.actor, obs, encoder_net.zs(policy.encoder, obs))

    def act(state: TD7State, obs: Array, key: Array, deterministic: bool = False) -> Array:
        actor_output = output(policy(state), obs)
        return rules.mode(actor_output) if deterministic else rules.explore(actor_output, key)

    def td_target(state: TD7State, batch: Transition, draws: Any) -> tuple[Array, dict[str, Array]]:
        """The clipped minimum over the target critics, minus the penalty (SQT paper, eqs. 19-20)."""
        zs = encoder_net.zs(state.fixed_encoder_target, batch.next_obs)
        target_output = actor_net.apply(state.target_actor, batch.next_obs, zs)
        next_action, entropy_term = rules.next_action(target_output, draws, state.scalars)
        zsa = encoder_net.zsa(state.fixed_encoder_target, zs, next_action)
        next_q = critic_net.apply(state.target_critic, batch.next_obs, next_action, zsa, zs)
        bounds = state.value_bounds.low, state.value_bounds.high
        return critics.td_target(config, state, batch, next_q, draws, entropy_term=entropy_term, value_bounds=bounds)

    def update_encoder(state: TD7State, batch: Transition) -> tuple[TD7State, Metrics]:
        def loss_fn(encoder):
            zsa = encoder_net.zsa(encoder, encoder_net.zs(encoder, batch.obs), batch.action)
            return encoder_loss(zsa, encoder_net.zs(encoder, batch.next_obs))

        loss, grads = jax.value_and_grad(loss_fn)(state.encoder)
        encoder, encoder_opt, diverged = adam_step(
            state.encoder, state.encoder_opt, grads, state.scalars.lr, state.diverged
        )
        return state._replace(encoder=encoder, encoder_opt=encoder_opt, diverged=diverged), {"encoder_loss": loss}

    def update_critic(state: TD7State, batch: Transition, zs: Array, draws: Any) -> tuple[TD7State, Array, Metrics]:
        target, terms = td_target(state, batch, draws)
        zsa = encoder_net.zsa(state.fixed_encoder, zs, batch.action)

        def q_values(critic):
            return critic_net.apply(critic, batch.obs, batch.action, zsa, zs)

        loss = functools.partial(lap_huber, min_priority=config.min_priority)
        state, td_error, metrics = critics.update(config, state, q_values, target, terms, loss)
        bounds = trees.where(state.diverged, state.value_bounds, state.value_bounds.track(target))
        return state._replace(value_bounds=bounds), td_error, metrics

    def update_actor(state: TD7State, batch: Transition, zs: Array, draws: Any) -> tuple[TD7State, Metrics]:
        def loss_fn(actor):
            actor_output = actor_net.apply(actor, batch.obs, zs)
            action, entropy_term, metrics = rules.actor_action(actor_output, draws, state.scalars)
            zsa = encoder_net.zsa(state.fixed_encoder, zs, action)
            q = critic_net.apply(state.critic, batch.obs, action, zsa, zs)
            return -jnp.mean(q_targets.ACTOR_REDUCTIONS[config.actor_reduce](q) - entropy_term), metrics

        (loss, metrics), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.actor)
        actor, actor_opt, diverged = adam_step(state.actor, state.actor_opt, grads, state.scalars.lr, state.diverged)
        return state._replace(actor=actor, actor_opt=actor_opt, diverged=diverged), {"actor_loss": loss} | metrics

    def copy_targets(state: TD7State) -> TD7State:
        copied = state._replace(
            target_actor=state.actor,
            target_critic=state.critic,
            fixed_encoder_target=state.fixed_encoder,
            fixed_encoder=state.encoder,
            value_bounds=state.value_bounds.put_in_use(),
        )
        return trees.where(state.diverged, state, copied)

    def update(state: TD7State, batch: Transition, draws: Any, step: Array) -> tuple[TD7State, Array, Metrics]:
        state, encoder_metrics = update_encoder(state, batch) if train_encoder else (state, {})
        zs = encoder_net.zs(state.fixed_encoder, batch.obs)
        state, td_error, metrics = update_critic(state, batch, zs, draws)

        def delayed(state_and_metrics):
            return update_actor(state_and_metrics[0], batch, zs, draws)

        skipped = dict.fromkeys(jax.eval_shape(update_actor, state, batch, zs, draws)[1], not_measured())
        state, actor_metrics = apply_every(config.policy_delay, step, delayed, (state, skipped))
        state = apply_every(config.target_update_period, step, copy_targets, state)
        return state, td_error, metrics | actor_metrics | encoder_metrics

    def q_values(state: TD7State, obs: Array, action: Array) -> Array:
        zs = encoder_net.zs(state.fixed_encoder, obs)
        return critic_net.apply(state.critic, obs, action, encoder_net.zsa(state.fixed_encoder, zs, action), zs)

    def sample(state: TD7State, obs: Array, key: Array) -> tuple[Array, Array]:
        assert rules.sample
        return rules.sample(output(policy(state), obs), key, state.scalars)

    def status(state: TD7State) -> Metrics:
        return {"value_low": state.value_bounds.low, "value_high": state.value_bounds.high}

    views = Views(
        policy=policy,
        policy_action=lambda policy, obs: rules.mode(output(policy, obs)),
        q_values=q_values,
        sample=sample if rules.sample else None,
        status=status if clip_values else lambda state: {},
    )
    return assemble(init=init, act=act, draw=rules.draw, update=update, td_target=td_target, views=views)
