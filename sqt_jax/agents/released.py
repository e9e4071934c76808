"""The agents that the authors of SQT released as TD3, SAC and TD7 (`--preset=released`; see BUILD_NOTES.md).

All three train TD7's networks with TD7's update (`td7.build_learner`). Their actors are Gaussian: those of TD3 and TD7
act by the mode and are updated by samples; SAC's log-probabilities are those before tanh, averaged over the action's
dimensions. In TD3 and SAC the encoder is never trained, values are not clipped and there are no policy checkpoints.
Each of these is a setting, named in `SETTINGS`; with all of them as in the papers, the agents are `td3`, `sac`, `td7`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sqt_jax.agents import sac, td3, td7
from sqt_jax.config import AgentConfig
from sqt_jax.gaussian import Gaussian
from sqt_jax.types import Array, Metrics, Parts, Scalars, Transition

SETTINGS = ("networks", "sampled_actor", "squashed_log_prob", "train_encoder", "value_clipping")


class GaussianTD3Draws(NamedTuple):
    target_noise: Array  # [B, A], scaled, not yet clipped
    subset: Array  # [M]: critics of the target
    action_eps: Array  # [B, A] standard normal: the action of the actor's update


def gaussian_td3(config: AgentConfig) -> td7.ActionRules:
    """TD3's rules for a Gaussian actor: its mode acts, its samples update it."""

    def draw(key: Array, batch: Transition) -> GaussianTD3Draws:
        key, action_key = jax.random.split(key)
        action_eps = jax.random.normal(action_key, batch.action.shape)
        return GaussianTD3Draws(**td3.draw(key, batch, config)._asdict(), action_eps=action_eps)

    def next_action(output: Gaussian, draws: GaussianTD3Draws, scalars: Scalars) -> tuple[Array, float]:
        return td3.smooth(output.mode(), draws.target_noise, config), 0.0

    def actor_action(output: Gaussian, draws: GaussianTD3Draws, scalars: Scalars) -> tuple[Array, float, Metrics]:
        return output.sample(draws.action_eps)[0], 0.0, {}

    return td7.ActionRules(
        gaussian=True,
        mode=Gaussian.mode,
        explore=lambda output, key: td3.explore(output.mode(), key, config),
        draw=draw,
        next_action=next_action,
        actor_action=actor_action,
    )


def sample(output: Gaussian, eps: Array, config: AgentConfig) -> tuple[Array, Array]:
    """Action [B, A] and log-probability [B] for eps [B, A]; without `squashed_log_prob` the released code's."""
    action, log_prob = output.sample(eps)
    if config.squashed_log_prob:
        return action, log_prob
    before_tanh = -0.5 * eps**2 - output.log_std - 0.5 * jnp.log(2 * jnp.pi)
    return action, jnp.mean(before_tanh, axis=-1)


def gaussian_sac(config: AgentConfig) -> td7.ActionRules:
    """SAC's rules, with the released log-probability."""

    def next_action(output: Gaussian, draws: sac.SACDraws, scalars: Scalars) -> tuple[Array, Array]:
        action, log_prob = sample(output, draws.next_action_eps, config)
        return action, scalars.temperature * log_prob

    def actor_action(output: Gaussian, draws: sac.SACDraws, scalars: Scalars) -> tuple[Array, Array, Metrics]:
        action, log_prob = sample(output, draws.action_eps, config)
        metrics = {"entropy": -jnp.mean(log_prob), "temperature": jnp.asarray(scalars.temperature)}
        return action, scalars.temperature * log_prob, metrics

    def explore(output: Gaussian, key: Array) -> Array:
        return output.sample(jax.random.normal(key, output.mean.shape))[0]

    def sample_with_bonus(output: Gaussian, key: Array, scalars: Scalars) -> tuple[Array, Array]:
        action, log_prob = sample(output, jax.random.normal(key, output.mean.shape), config)
        return action, -scalars.temperature * log_prob

    return td7.ActionRules(
        gaussian=True,
        mode=Gaussian.mode,
        explore=explore,
        sample=sample_with_bonus,
        draw=lambda key, batch: sac.draw(key, batch, config),
        next_action=next_action,
        actor_action=actor_action,
    )


def _learner(config: AgentConfig, observation_size: int, action_size: int, rules: td7.ActionRules) -> Parts:
    train_encoder, clip_values = config.train_encoder, config.value_clipping
    return td7.build_learner(config, observation_size, action_size, rules, train_encoder, clip_values)


def _td3_rules(config: AgentConfig) -> td7.ActionRules:
    return gaussian_td3(config) if config.sampled_actor else td7.deterministic(config)


def build_td3(config: AgentConfig, observation_size: int, action_size: int) -> Parts:
    """TD7's update with TD3's rules, without policy checkpoints."""
    return _learner(config, observation_size, action_size, _td3_rules(config))


def build_sac(config: AgentConfig, observation_size: int, action_size: int) -> Parts:
    """The next action is a sample of the target actor, not of the current one."""
    return _learner(config, observation_size, action_size, gaussian_sac(config))


def build_td7(config: AgentConfig, observation_size: int, action_size: int) -> Parts:
    """TD7, its actor Gaussian if `sampled_actor`."""
    learner = _learner(config, observation_size, action_size, _td3_rules(config))
    return td7.with_checkpoints(config, learner, observation_size)
