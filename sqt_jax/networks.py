"""Actors and critics. Parameters are `{layer: {kernel [in, out], bias [out]}}`; critics have a leading axis N."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from sqt_jax.types import Array, Params

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


class Network(NamedTuple):
    """A module as the two functions that are used of it."""

    init: Callable[..., Params]  # (key, *inputs) -> parameters
    apply: Callable[..., Any]  # (parameters, *inputs) -> outputs


def uniform(bound: float):
    """Initialiser of U(-bound, bound)."""

    def init(key, shape, dtype=jnp.float32):
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return init


class Dense(nn.Module):
    """A linear layer started as torch starts its own, U(±1/sqrt(fan_in)): what the papers' codes train from.

    Of several inputs side by side. Each is a product of its own, so that one which needs no gradient costs none.
    """

    features: int

    @nn.compact
    def __call__(self, *inputs: Array) -> Array:
        widths = [x.shape[-1] for x in inputs]
        init = uniform(sum(widths) ** -0.5)
        kernel = self.param("kernel", init, (sum(widths), self.features))
        bias = self.param("bias", init, (self.features,))
        rows = jnp.split(kernel, np.cumsum(widths)[:-1])
        return sum(x @ part for x, part in zip(inputs, rows, strict=True)) + bias


def hidden_layers(x: Array, hidden: Sequence[int]) -> Array:
    """ReLU layers `layer0`, `layer1`, ... of the calling module."""
    for i, width in enumerate(hidden):
        x = nn.relu(Dense(width, name=f"layer{i}")(x))
    return x


class TanhActor(nn.Module):
    """TD3's deterministic policy: obs [B, O] -> action [B, A] in (-1, 1)."""

    action_size: int
    hidden: Sequence[int]

    @nn.compact
    def __call__(self, obs: Array) -> Array:
        x = hidden_layers(obs, self.hidden)
        return jnp.tanh(Dense(self.action_size, name=f"layer{len(self.hidden)}")(x))


class Gaussian(NamedTuple):
    """A diagonal Gaussian whose samples are squashed by tanh."""

    mean: Array  # [B, A]
    log_std: Array  # [B, A]

    def mode(self) -> Array:
        """The action [B, A] of the mean: what acts where nothing is to be random."""
        return jnp.tanh(self.mean)

    def sample(self, eps: Array, squashed_log_prob: bool = True) -> tuple[Array, Array]:
        """Action [B, A] and its log-probability [B] for the standard-normal draw `eps [B, A]`.

        The tanh correction log(1 - tanh(u)²) is written 2 (log 2 - u - softplus(-2u)), which does not underflow
        (SAC, https://arxiv.org/abs/1801.01290, appendix C). Without `squashed_log_prob` the log-probability is the
        Gaussian's, before tanh, and averaged over the action's dimensions: what the authors of SQT released.
        """
        u = self.mean + jnp.exp(self.log_std) * eps
        log_prob = -0.5 * eps**2 - self.log_std - 0.5 * jnp.log(2 * jnp.pi)
        if not squashed_log_prob:
            return jnp.tanh(u), jnp.mean(log_prob, axis=-1)
        correction = 2 * (jnp.log(2.0) - u - jax.nn.softplus(-2 * u))
        return jnp.tanh(u), jnp.sum(log_prob - correction, axis=-1)


def clip_log_std(log_std: Array) -> Array:
    """Any shape; the limits are SAC's."""
    return jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX)


class GaussianActor(nn.Module):
    """SAC's policy: obs [B, O] -> the Gaussian before tanh."""

    action_size: int
    hidden: Sequence[int]

    @nn.compact
    def __call__(self, obs: Array) -> Gaussian:
        x = hidden_layers(obs, self.hidden)
        mean = Dense(self.action_size, name="mean")(x)
        log_std = Dense(self.action_size, name="log_std")(x)
        return Gaussian(mean, clip_log_std(log_std))


class Critic(nn.Module):
    """One Q function: obs [B, O], action [B, A] -> [B]."""

    hidden: Sequence[int]

    @nn.compact
    def __call__(self, obs: Array, action: Array) -> Array:
        x = hidden_layers(jnp.concatenate([obs, action], axis=-1), self.hidden)
        return Dense(1, name=f"layer{len(self.hidden)}")(x)[..., 0]


def network(module: nn.Module) -> Network:
    """A module's pure functions."""
    return Network(module.init, module.apply)


def ensemble(module: type[nn.Module], ensemble_size: int, hidden: Sequence[int]) -> Network:
    """N independent modules as one: parameters and outputs get a leading axis N, inputs are shared.

    Each gets its own copy of the inputs: a first layer of all of them at once would give [B, N, width], and XLA would
    turn that, and its kernel, round.
    """
    made = nn.vmap(
        module,
        in_axes=0,
        out_axes=0,
        axis_size=ensemble_size,
        variable_axes={"params": 0},
        split_rngs={"params": True},
    )(hidden)

    def each(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(key_or_params: Any, *inputs: Array) -> Any:
            return function(key_or_params, *(jnp.broadcast_to(x, (ensemble_size, *x.shape)) for x in inputs))

        return call

    return Network(each(made.init), each(made.apply))


def actor(action_size: int, hidden: Sequence[int], gaussian: bool) -> Network:
    """obs [B, O] -> action [B, A] in (-1, 1), or a `Gaussian` of [B, A]"""
    return network((GaussianActor if gaussian else TanhActor)(action_size, hidden))


def critic_ensemble(ensemble_size: int, hidden: Sequence[int]) -> Network:
    """N independent critics as one: obs [B, O], action [B, A] -> [N, B]"""
    return ensemble(Critic, ensemble_size, hidden)
