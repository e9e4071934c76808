"""How parameters move: Adam with a traced learning rate, and the soft step of target networks."""

import jax
import optax

from sqt_jax.types import Array, Params

_adam = optax.scale_by_adam()


def adam_init(params: Params) -> optax.OptState:
    return _adam.init(params)


def adam_step(
    params: Params, opt_state: optax.OptState, grads: Params, lr: Array | float
) -> tuple[Params, optax.OptState]:
    """One step of Adam. `lr` may be traced, so that a sweep over it compiles once."""
    direction, opt_state = _adam.update(grads, opt_state)
    return optax.apply_updates(params, jax.tree.map(lambda d: -lr * d, direction)), opt_state


def soft_update(target: Params, online: Params, tau: Array | float) -> Params:
    """(1 - tau) * target + tau * online, leaf by leaf."""
    return jax.tree.map(lambda t, o: (1 - tau) * t + tau * o, target, online)
