"""A condition that stays one under `vmap`.

`jax.lax.cond` on a batched predicate becomes a `select`: both branches run for all. Here the branch runs if the
predicate holds anywhere in the batch, and where it holds nowhere, nothing is computed and nothing is copied.

Derivatives go forward only (`jax.jvp`): JAX cannot transpose a function with a batching rule of its own. What is
trained here needs no derivative of an environment's step.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from sqt_jax.types import Array

Branch = Callable[[Any, Any], Any]


def rarely(predicate: Array, branch: Branch, old: Any, *, given: Any = ()) -> Any:
    """`branch(old, given)` where `predicate` [] holds, else `old`: for what most steps do not need.

    Args:
      branch: closes over no traced values, which `vmap` could not see; all it needs is in `old` and `given`. It gives
        a tree like `old`.
    """

    def select(predicate: Array, old: Any, given: Any) -> Any:
        return jax.tree.map(lambda a, b: jnp.where(predicate, a, b), branch(old, given), old)

    return _if_any(select)(predicate, old, given)


def _if_any(select: Callable) -> Callable:
    """`select(predicate, old, given)` if `predicate`, an array of any shape, holds anywhere; else `old`."""

    @custom_vmap
    def call(predicate: Array, old: Any, given: Any) -> Any:
        return jax.lax.cond(jnp.any(predicate), select, lambda predicate, old, given: old, predicate, old, given)

    @call.def_vmap
    def _(axis_size: int, in_batched: Any, *args: Any) -> tuple[Any, Any]:
        def everywhere(x: Array, batched: bool) -> Array:
            return x if batched else jnp.broadcast_to(x, (axis_size, *jnp.shape(x)))

        predicate, old, given = jax.tree.map(everywhere, args, tuple(in_batched))
        return _if_any(jax.vmap(select))(predicate, old, given), jax.tree.map(lambda _: True, old)

    return call
