"""Actor and critics as MLPs. Parameters: `{layer: {kernel [in, out], bias [out]}}`, critics with a leading axis N."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from sqt_jax.types import Array, Params


class Network(NamedTuple):  # what is used of a flax module
    init: Callable[..., Params]  # (key, *inputs) -> parameters
    apply: Callable[..., Any]  # (parameters, *inputs) -> outputs


class Dense(nn.Module):
    """A linear layer of several inputs with a matrix product each; torch's initialisation, U(±1/sqrt(fan_in))."""

    features: int

    @nn.compact
    def __call__(self, *inputs: Array) -> Array:
        widths = [x.shape[-1] for x in inputs]
        bound = sum(widths) ** -0.5

        def uniform(key, shape):
            return jax.random.uniform(key, shape, jnp.float32, -bound, bound)

        kernel = self.param("kernel", uniform, (sum(widths), self.features))
        bias = self.param("bias", uniform, (self.features,))
        rows = jnp.split(kernel, np.cumsum(widths)[:-1])
        return sum(x @ part for x, part in zip(inputs, rows, strict=True)) + bias


def hidden_layers(x: Array, hidden: Sequence[int], layer_norm: bool = False) -> Array:
    """ReLU layers `layer0`, `layer1`, ... of the calling module.

    Args:
      layer_norm: whether each is normalised before its ReLU, by `norm0`, `norm1`, ...
        (https://arxiv.org/abs/1607.06450).
    """
    for i, width in enumerate(hidden):
        x = Dense(width, name=f"layer{i}")(x)
        if layer_norm:
            x = nn.LayerNorm(name=f"norm{i}")(x)
        x = nn.relu(x)
    return x


class TanhActor(nn.Module):
    """TD3's deterministic policy: obs [B, O] -> action [B, A] in (-1, 1)."""

    action_size: int
    hidden: Sequence[int]

    @nn.compact
    def __call__(self, obs: Array) -> Array:
        x = hidden_layers(obs, self.hidden)
        return jnp.tanh(Dense(self.action_size, name=f"layer{len(self.hidden)}")(x))


class Critic(nn.Module):
    """One Q function: obs [B, O], action [B, A] -> [B]."""

    hidden: Sequence[int]
    layer_norm: bool = False

    @nn.compact
    def __call__(self, obs: Array, action: Array) -> Array:
        x = hidden_layers(jnp.concatenate([obs, action], axis=-1), self.hidden, self.layer_norm)
        return Dense(1, name=f"layer{len(self.hidden)}")(x)[..., 0]


def ensemble(module: type[nn.Module], ensemble_size: int, *settings: Any) -> Network:
    """N independent modules as one: parameters and outputs get a leading axis N, inputs are shared.

    Args:
      settings: the fields of each module.
    """
    axes: dict[str, Any] = {"variable_axes": {"params": 0}, "split_rngs": {"params": True}}
    made = nn.vmap(module, axis_size=ensemble_size, **axes)(*settings)

    def copies(
        inputs: Sequence[Array],
    ) -> list[Array]:  # with shared inputs XLA would transpose the first layer's result
        return [jnp.broadcast_to(x, (ensemble_size, *x.shape)) for x in inputs]

    return Network(
        init=lambda key, *inputs: made.init(key, *copies(inputs)),
        apply=lambda params, *inputs: made.apply(params, *copies(inputs)),
    )
