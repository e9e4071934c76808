"""Adam with a traced learning rate, and the soft update of target networks. Neither moves once an agent diverged."""

import jax
import jax.numpy as jnp
import optax

from sqt_jax import trees
from sqt_jax.types import Array, Params

_adam = optax.scale_by_adam()
adam_init = _adam.init  # parameters -> moments


def adam_step(
    params: Params, opt_state: optax.OptState, grads: Params, lr: Array | float, diverged: Array
) -> tuple[Params, optax.OptState, Array]:
    """One step of Adam, unless `diverged` [] or the gradients are not finite or too large to be squared.

    Returns the parameters, the optimizer's state and whether the agent has diverged now.
    """
    diverged = diverged | ~jnp.isfinite(optax.tree.norm(grads, squared=True))
    direction, moments = _adam.update(grads, opt_state)
    moved = optax.apply_updates(params, jax.tree.map(lambda d: -lr * d, direction))
    return trees.where(diverged, params, moved), trees.where(diverged, opt_state, moments), diverged


def soft_update(target: Params, online: Params, tau: Array | float, diverged: Array) -> Params:
    """(1 - tau) * target + tau * online, leaf by leaf; `target` where `diverged` []."""
    return trees.where(diverged, target, jax.tree.map(lambda t, o: (1 - tau) * t + tau * o, target, online))
