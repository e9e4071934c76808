"""Helpers for trees of arrays: leaves by path, and a selection between two trees."""

from typing import Any

import jax
import jax.numpy as jnp

from sqt_jax.types import Array


def by_path(tree: Any) -> dict[str, Any]:
    """The leaves by their path (for example "params/layer0/kernel"), in the order of the tree."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def from_paths(like: Any, leaves: dict[str, Any]) -> Any:
    """The inverse of `by_path`: a tree with the structure of `like` and these leaves by path.

    Raises:
      KeyError: a leaf is missing; further leaves are ignored.
    """
    return jax.tree.unflatten(jax.tree.structure(like), [leaves[path] for path in by_path(like)])


def where(condition: Array, a: Any, b: Any) -> Any:
    """`a` if `condition` [] holds, else `b`: two trees of the same structure and shapes."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def strong(tree: Any) -> Any:
    """The same leaves as arrays without weak types: `jit` would compile once for the weak and once for the strong."""
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, jnp.result_type(leaf)), tree)
