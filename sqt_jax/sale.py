"""TD7's networks: actor and critics conditioned on state-action learned embeddings, SALE
(https://arxiv.org/abs/2306.02451, section 4).

The encoder gives zs(obs) and zsa(zs, action), trained so that zsa predicts the zs of the next observation.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp

from sqt_jax.gaussian import Gaussian, clip_log_std
from sqt_jax.networks import Dense, Network, ensemble
from sqt_jax.types import Array, Params


def avg_l1_norm(x: Array) -> Array:
    """x / mean|x| along the last axis (eq. 4); finite at 0."""
    return x / jnp.maximum(jnp.mean(jnp.abs(x), axis=-1, keepdims=True), 1e-8)


class Encoder(nn.Module):
    """The two embeddings, [B, Z] each. Layers `state0..`, `state_action0..`; ELU between them."""

    embedding_size: int
    hidden: Sequence[int]

    def setup(self):
        widths = (*self.hidden, self.embedding_size)
        self.state_layers = [Dense(width, name=f"state{i}") for i, width in enumerate(widths)]
        self.state_action_layers = [Dense(width, name=f"state_action{i}") for i, width in enumerate(widths)]

    def zs(self, obs: Array) -> Array:
        """obs [B, O] -> [B, Z]"""
        x = obs
        for layer in self.state_layers[:-1]:
            x = nn.elu(layer(x))
        return avg_l1_norm(self.state_layers[-1](x))

    def zsa(self, zs: Array, action: Array) -> Array:
        """zs [B, Z], action [B, A] -> [B, Z]"""
        first, *others = self.state_action_layers[:-1]
        x = nn.elu(first(zs, action))
        for layer in others:
            x = nn.elu(layer(x))
        return self.state_action_layers[-1](x)

    def __call__(self, obs: Array, action: Array) -> tuple[Array, Array]:
        zs = self.zs(obs)
        return zs, self.zsa(zs, action)


class SaleActor(nn.Module):
    """obs [B, O], zs [B, Z] -> action [B, A] in (-1, 1), or the `Gaussian` before tanh; ReLU."""

    action_size: int
    hidden: Sequence[int]
    gaussian: bool = False

    @nn.compact
    def __call__(self, obs: Array, zs: Array) -> Array | Gaussian:
        x = avg_l1_norm(Dense(self.hidden[0], name="layer0")(obs))
        x = nn.relu(Dense(self.hidden[0], name="layer1")(x, zs))
        for i, width in enumerate(self.hidden[1:], start=2):
            x = nn.relu(Dense(width, name=f"layer{i}")(x))
        mean = Dense(self.action_size, name=f"layer{len(self.hidden) + 1}")(x)
        if not self.gaussian:
            return jnp.tanh(mean)
        return Gaussian(mean, clip_log_std(Dense(self.action_size, name="log_std")(x)))


class SaleCritic(nn.Module):
    """One Q function: obs [B, O], action [B, A], zsa and zs [B, Z] -> [B]; ELU."""

    hidden: Sequence[int]

    @nn.compact
    def __call__(self, obs: Array, action: Array, zsa: Array, zs: Array) -> Array:
        x = avg_l1_norm(Dense(self.hidden[0], name="layer0")(jnp.concatenate([obs, action], axis=-1)))
        x = nn.elu(Dense(self.hidden[0], name="layer1")(x, zsa, zs))
        for i, width in enumerate(self.hidden[1:], start=2):
            x = nn.elu(Dense(width, name=f"layer{i}")(x))
        return Dense(1, name=f"layer{len(self.hidden) + 1}")(x)[..., 0]


class EncoderNetwork(NamedTuple):
    """Two functions of the same parameters."""

    init: Callable[..., Params]  # (key, obs [B, O], action [B, A])
    zs: Callable[..., Any]  # (parameters, obs [B, O]) -> [B, Z]
    zsa: Callable[..., Any]  # (parameters, zs [B, Z], action [B, A]) -> [B, Z]


def encoder(embedding_size: int, hidden: Sequence[int]) -> EncoderNetwork:
    """SALE's two encoders: zs of obs [B, O], zsa of zs [B, Z] and action [B, A], both [B, Z]."""
    module = Encoder(embedding_size, hidden)
    return EncoderNetwork(
        module.init, functools.partial(module.apply, method="zs"), functools.partial(module.apply, method="zsa")
    )


def sale_actor(action_size: int, hidden: Sequence[int], gaussian: bool = False) -> Network:
    """obs [B, O], zs [B, Z] -> action [B, A] in (-1, 1), or a `Gaussian` of [B, A]"""
    module = SaleActor(action_size, hidden, gaussian)
    return Network(init=module.init, apply=module.apply)


def sale_critics(ensemble_size: int, hidden: Sequence[int]) -> Network:
    """N independent critics as one: obs [B, O], action [B, A], zsa [B, Z], zs [B, Z] -> [N, B]"""
    return ensemble(SaleCritic, ensemble_size, hidden)
