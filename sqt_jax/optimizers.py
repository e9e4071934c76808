"""Parameter updates: Adam with a traced learning rate, and the soft update of target networks.

Both return the old values once the agent has diverged. The selection is fused with the step and costs no copy.
"""

import jax
import jax.numpy as jnp
import optax

from sqt_jax import trees
from sqt_jax.types import Array, Params

_adam = optax.scale_by_adam()
adam_init = _adam.init  # parameters -> moments


def adam_step(
    params: Params, opt_state: optax.OptState, grads: Params, lr: Array | float, diverged: Array
) -> tuple[Params, optax.OptState]:
    """One step of Adam, or none where `diverged` []. `lr` may be traced."""
    direction, moments = _adam.update(grads, opt_state)
    moved = optax.apply_updates(params, jax.tree.map(lambda d: -lr * d, direction))
    return trees.where(diverged, (params, opt_state), (moved, moments))


def overflows(grads: Params) -> Array:
    """[] bool: whether a gradient is not finite, or too large for Adam to square it."""
    return ~jnp.isfinite(optax.tree.norm(grads, squared=True))


def soft_update(target: Params, online: Params, tau: Array | float, diverged: Array) -> Params:
    """(1 - tau) * target + tau * online, leaf by leaf; `target` where `diverged` []."""
    return trees.where(diverged, target, jax.tree.map(lambda t, o: (1 - tau) * t + tau * o, target, online))
