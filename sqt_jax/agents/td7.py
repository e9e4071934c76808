"""TD7 (https://arxiv.org/abs/2306.02451) with N critics and the variant's target.

TD3 with embeddings (SALE), prioritised replay (LAP: the replay is `sqt_jax.lap`), value bounds, hard target copies and
policy checkpoints (`assessment`). Around SAC's way of acting, or without the checkpoints, the same update is what the
authors of SQT released under the names of SAC and TD3: `--networks=sale`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from sqt_jax import losses, sale, trees
from sqt_jax.agents import assessment, td3
from sqt_jax.agents import critic as critics
from sqt_jax.agents.actions import Actions, Output
from sqt_jax.config import AgentConfig
from sqt_jax.optimizers import adam_init, adam_step, overflows
from sqt_jax.types import Agent, Array, Metrics, Params, Scalars, Transition

Noise = Any  # what the way of acting draws; it has a `subset` of critics


class ValueBounds(NamedTuple):
    """The smallest and largest targets seen so far, and the pair in use, which clips the next value."""

    running_min: Array  # []
    running_max: Array  # []
    low: Array  # []
    high: Array  # []

    @classmethod
    def start(cls) -> "ValueBounds":
        bound, zero = jnp.float32(1e8), jnp.zeros(())
        return cls(running_min=bound, running_max=-bound, low=zero, high=zero)

    def track(self, target: Array) -> "ValueBounds":
        return self._replace(
            running_min=jnp.minimum(self.running_min, jnp.min(target)),
            running_max=jnp.maximum(self.running_max, jnp.max(target)),
        )

    def put_in_use(self) -> "ValueBounds":
        return self._replace(low=self.running_min, high=self.running_max)


class Policy(NamedTuple):
    """What acting needs."""

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
    value_bounds: ValueBounds | None  # none where values are not clipped
    checkpoints: assessment.Checkpoints | None  # none where policies are not assessed
    scalars: Scalars
    gradient_steps: Array  # [] int32: updates done
    diverged: Array  # [] bool: nothing moves any more (`critic.update`)


def make(config: AgentConfig, observation_size: int, action_size: int) -> Agent:
    """TD7 for observations [B, O] and actions [B, A] of these sizes."""
    return make_sale_agent(config, observation_size, action_size, td3.actions(config), assessed=True)


def make_sale_agent(
    config: AgentConfig, observation_size: int, action_size: int, acting: Actions, assessed: bool
) -> Agent:
    """TD7 with any way of acting; where policies are not `assessed`, the learner acts and is evaluated."""
    encoder_net = sale.encoder(config.embedding_size, config.hidden)
    actor_net = sale.sale_actor(action_size, config.hidden, acting.gaussian)
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
            value_bounds=ValueBounds.start() if config.value_clipping else None,
            checkpoints=assessment.start(Policy(actor, encoder)) if assessed else None,
            scalars=(scalars or config.scalars()).as_arrays(),
            gradient_steps=jnp.zeros((), jnp.int32),
            diverged=jnp.zeros((), bool),
        )

    def learner(state: TD7State) -> Policy:
        return Policy(state.actor, state.fixed_encoder)

    def output(policy: Policy, obs: Array) -> Output:
        return actor_net.apply(policy.actor, obs, encoder_net.zs(policy.encoder, obs))

    def policy_action(policy: Policy, obs: Array) -> Array:
        return acting.greedy(output(policy, obs))

    def evaluated_policy(state: TD7State) -> Policy:
        return state.checkpoints.checkpoint if state.checkpoints else learner(state)

    def act(state: TD7State, obs: Array, key: Array, deterministic: bool = False) -> Array:
        if deterministic:
            return policy_action(evaluated_policy(state), obs)
        behaviour = state.checkpoints.snapshot if state.checkpoints else learner(state)
        return acting.explore(output(behaviour, obs), key)

    def observe(state: TD7State, episode_return: Array, ended: Array) -> TD7State:
        if not state.checkpoints:
            return state
        if episode_return.shape != (1,) or ended.shape != (1,):
            raise ValueError(f"td7 expects one environment: returns and ends of [1], not {episode_return.shape}")
        checkpoints = assessment.assess(
            config,
            state.checkpoints,
            learner(state),
            state.gradient_steps,
            episode_return[0],
            ended[0] & ~state.diverged,
        )
        return state._replace(checkpoints=checkpoints)

    def td_target(state: TD7State, batch: Transition, noise: Noise) -> tuple[Array, dict[str, Array]]:
        bounds = state.value_bounds
        zs = encoder_net.zs(state.fixed_encoder_target, batch.next_obs)
        target_output = actor_net.apply(state.target_actor, batch.next_obs, zs)
        next_action, next_log_prob = acting.next_action(target_output, noise)
        zsa = encoder_net.zsa(state.fixed_encoder_target, zs, next_action)
        next_q = critic_net.apply(state.target_critic, batch.next_obs, next_action, zsa, zs)
        target, terms = critics.td_target(
            config,
            state.scalars,
            batch,
            next_q,
            noise.subset,
            entropy_term=state.scalars.temperature * next_log_prob if acting.entropy else 0.0,
            value_bounds=(bounds.low, bounds.high) if bounds else None,
        )
        return target, terms | ({"next_log_prob": next_log_prob} if acting.entropy else {})

    def update_encoder(state: TD7State, batch: Transition) -> tuple[TD7State, Array]:
        def loss_fn(encoder):
            zsa = encoder_net.zsa(encoder, encoder_net.zs(encoder, batch.obs), batch.action)
            return losses.encoder_loss(zsa, encoder_net.zs(encoder, batch.next_obs))

        loss, grads = jax.value_and_grad(loss_fn)(state.encoder)
        diverged = state.diverged | overflows(grads)
        encoder, encoder_opt = adam_step(state.encoder, state.encoder_opt, grads, state.scalars.lr, diverged)
        return state._replace(encoder=encoder, encoder_opt=encoder_opt, diverged=diverged), loss

    def update_critic(state: TD7State, batch: Transition, zs: Array, noise: Noise) -> tuple[TD7State, Array, Metrics]:
        target, terms = td_target(state, batch, noise)
        zsa = encoder_net.zsa(state.fixed_encoder, zs, batch.action)
        state, td_error, metrics = critics.update(
            lambda params: critic_net.apply(params, batch.obs, batch.action, zsa, zs),
            lambda q: losses.lap_huber(q, target, config.min_priority),
            config,
            state,
            target,
            terms,
        )
        bounds = state.value_bounds and trees.where(
            state.diverged, state.value_bounds, state.value_bounds.track(target)
        )
        return state._replace(value_bounds=bounds), td_error, metrics

    def update_actor(state: TD7State, batch: Transition, zs: Array, noise: Noise) -> tuple[TD7State, Metrics]:
        def loss_fn(actor):
            action, log_prob = acting.own_action(actor_net.apply(actor, batch.obs, zs), noise)
            zsa = encoder_net.zsa(state.fixed_encoder, zs, action)
            q = critic_net.apply(state.critic, batch.obs, action, zsa, zs)
            value = losses.actor_value(q, config.actor_reduce)
            if acting.entropy:
                value -= state.scalars.temperature * log_prob
            return -jnp.mean(value), log_prob

        (loss, log_prob), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.actor)
        diverged = state.diverged | overflows(grads)
        actor, actor_opt = adam_step(state.actor, state.actor_opt, grads, state.scalars.lr, diverged)
        metrics = {"actor_loss": loss}
        if acting.entropy:
            metrics |= {"entropy": -jnp.mean(log_prob), "temperature": state.scalars.temperature}
        return state._replace(actor=actor, actor_opt=actor_opt, diverged=diverged), metrics

    def copy_targets(state: TD7State) -> TD7State:
        bounds = state.value_bounds
        copied = state._replace(
            target_actor=state.actor,
            target_critic=state.critic,
            fixed_encoder_target=state.fixed_encoder,
            fixed_encoder=state.encoder,
            value_bounds=bounds.put_in_use() if bounds else None,
        )
        return trees.where(state.diverged, state, copied)

    def update_with_noise(state: TD7State, batch: Transition, noise: Noise) -> tuple[TD7State, Array, Metrics]:
        encoder_metrics = {}
        if config.train_encoder:
            state, encoder_metrics["encoder_loss"] = update_encoder(state, batch)
        zs = encoder_net.zs(state.fixed_encoder, batch.obs)
        state, td_error, metrics = update_critic(state, batch, zs, noise)
        gradient_steps = state.gradient_steps + 1

        def skip(state, *inputs):
            actor_metrics = jax.eval_shape(update_actor, state, *inputs)[1]
            return state, dict.fromkeys(actor_metrics, jnp.full((), jnp.nan))  # not measured

        # Scalars that members share: real branches under vmap.
        actor_due = gradient_steps % config.policy_delay == 0
        copy_due = gradient_steps % config.target_update_period == 0
        state, actor_metrics = jax.lax.cond(actor_due, update_actor, skip, state, batch, zs, noise)
        state = jax.lax.cond(copy_due, copy_targets, lambda state: state, state)
        if state.checkpoints:
            lowered = assessment.lower_best(config, state.checkpoints, gradient_steps)
            state = state._replace(checkpoints=lowered)
        state = state._replace(gradient_steps=gradient_steps)
        return state, td_error, metrics | actor_metrics | encoder_metrics

    def update(state: TD7State, batch: Transition, key: Array) -> tuple[TD7State, Array, Metrics]:
        return update_with_noise(state, batch, acting.draw_noise(key, batch))

    def q_values(state: TD7State, obs: Array, action: Array) -> Array:
        zs = encoder_net.zs(state.fixed_encoder, obs)
        return critic_net.apply(state.critic, obs, action, encoder_net.zsa(state.fixed_encoder, zs, action), zs)

    def valued_act(state: TD7State, obs: Array, key: Array) -> tuple[Array, Array]:
        gaussian = output(learner(state), obs)
        action, log_prob = gaussian.sample(jax.random.normal(key, gaussian.mean.shape), config.squashed_log_prob)
        return action, -state.scalars.temperature * log_prob

    def status(state: TD7State) -> Metrics:
        metrics: Metrics = assessment.status(state.checkpoints) if state.checkpoints else {}
        if state.value_bounds:
            metrics |= {"value_low": state.value_bounds.low, "value_high": state.value_bounds.high}
        return metrics

    return Agent(
        init,
        act,
        update,
        acting.draw_noise,
        update_with_noise,
        td_target,
        evaluated_policy,
        policy_action,
        q_values,
        valued_act if acting.entropy else None,
        observe,
        status,
    )
