"""Conditions that stay real branches under `vmap`, without copies of what they change.

A branch is a loop of one iteration or none. XLA writes a loop's state in place; a conditional copies all that its
branches return, also where nothing changes.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from sqt_jax.types import Array

Branch = Callable[[Any, Any], Any]  # (old, given) -> a tree like old


def apply_if(predicate: Array, function: Callable[[Any], Any], state: Any) -> Any:
    """`function(state)` if `predicate` holds, else `state`.

    Under `vmap` the predicate must be shared by all entries, else both are computed for all. Only forward derivatives
    are supported.

    Args:
      predicate: [] bool.
      function: returns a tree with the structure, shapes and dtypes of `state`.
    """

    # The condition computes nothing. By that, benchmarks/operations.py tells a branch from a loop.
    def once(carry: tuple[Array, Any]) -> tuple[Array, Any]:
        return jnp.zeros((), bool), function(carry[1])

    return jax.lax.while_loop(lambda carry: carry[0], once, (jnp.asarray(predicate), state))[1]


def apply_every(period: int, step: Array, function: Callable[[Any], Any], state: Any) -> Any:
    """`function(state)` at the updates `period`, 2 × `period` and so on, else `state`.

    Args:
      step: [] int32, the number of updates done before; members share it.
      function: as in `apply_if`.
    """
    if period == 1:
        return function(state)
    with jax.named_scope(f"every_{period}_updates"):
        return apply_if((step + 1) % period == 0, function, state)


def cond_if_any(predicate: Array, branch: Branch, old: Any, *, given: Any = ()) -> Any:
    """`branch(old, given)` if `predicate` holds, else `old`; under `vmap` the branch runs only if any entry needs it.

    Under `vmap`, `lax.cond` on a batched predicate becomes a select and runs both branches for all; this runs the
    branch only if the predicate holds for at least one batch entry, and copies nothing if it holds for none. Entries
    for which it does not hold keep `old`. Use it for updates that are rare and expensive, like the start of an episode.

    Only forward derivatives (`jax.jvp`) are supported.

    Args:
      predicate: [] bool.
      branch: `(old, given) -> new`, a tree with the structure, shapes and types of `old`. It must not close over traced
        values, because `vmap` does not see those: pass them in `given`.
      old: a tree of arrays, returned where `predicate` is false.
      given: a tree of further arrays for the branch.

    Returns:
      A tree like `old`.
    """

    def select(predicate: Array, old: Any, given: Any) -> Any:
        return jax.tree.map(lambda a, b: jnp.where(predicate, a, b), branch(old, given), old)

    return _if_any(select)(predicate, old, given)


def _if_any(select: Callable) -> Callable:
    """`select(predicate, old, given)` if any entry of `predicate`, an array of any shape, holds; else `old`."""

    @custom_vmap
    def call(predicate: Array, old: Any, given: Any) -> Any:
        return apply_if(jnp.any(predicate), lambda old: select(predicate, old, given), old)

    @call.def_vmap
    def _(axis_size: int, in_batched: Any, *args: Any) -> tuple[Any, Any]:
        def batch(x: Array, batched: bool) -> Array:
            return x if batched else jnp.broadcast_to(x, (axis_size, *jnp.shape(x)))

        predicate, old, given = jax.tree.map(batch, args, tuple(in_batched))
        return _if_any(jax.vmap(select))(predicate, old, given), jax.tree.map(lambda _: True, old)

    return call


@custom_vmap
def any_in_batch(x: Array) -> Array:
    """Whether `x` [] bool holds for any entry of the batch that `vmap` makes: one answer for all, [] bool.

    It has no axis of the batch, so a loop or a condition on it is not computed for each entry.
    """
    return x


@any_in_batch.def_vmap
def _(axis_size: int, in_batched: Any, x: Array) -> tuple[Array, bool]:
    del axis_size
    return any_in_batch(jnp.any(x) if in_batched[0] else x), False
