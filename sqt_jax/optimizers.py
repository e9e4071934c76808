"""Adam with a traced learning rate, and the soft update of target networks. Neither moves once an agent diverged."""

import jax
import jax.numpy as jnp
import optax

from sqt_jax import trees
from sqt_jax.types import Array, Params

_B1, _B2, _EPS = 0.9, 0.999, 1e-8  # optax's defaults, PyTorch's too
_adam = optax.scale_by_adam(_B1, _B2, _EPS)
adam_init = _adam.init  # parameters -> moments


def adam_step(
    params: Params, opt_state: optax.OptState, grads: Params, lr: Array | float, diverged: Array
) -> tuple[Params, optax.OptState, Array]:
    """One step of Adam, unless `diverged` [] or the gradients are not finite or too large to be squared.

    Returns the parameters, the optimizer's state and whether the agent has diverged now.
    """
    diverged = diverged | ~jnp.isfinite(optax.tree.norm(grads, squared=True))
    _, moments = _adam.update(grads, opt_state)
    # The barrier: on a CPU XLA would compute the moments twice, the second time from copies of the old ones.
    moments = jax.lax.optimization_barrier(trees.where(diverged, opt_state, moments))
    mean = optax.tree.bias_correction(moments.mu, _B1, moments.count)
    variance = optax.tree.bias_correction(moments.nu, _B2, moments.count)
    step = jax.tree.map(lambda m, v: -lr * (m / (jnp.sqrt(v) + _EPS)), mean, variance)
    return trees.where(diverged, params, optax.apply_updates(params, step)), moments, diverged


def soft_update(target: Params, online: Params, tau: Array | float, diverged: Array) -> Params:
    """(1 - tau) * target + tau * online, leaf by leaf; `target` where `diverged` []."""
    return trees.where(diverged, target, jax.tree.map(lambda t, o: (1 - tau) * t + tau * o, target, online))
