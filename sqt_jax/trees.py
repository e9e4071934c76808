"""Trees of arrays: names of their leaves, and selections between two of a kind."""

from typing import Any

import jax
import jax.numpy as jnp

from sqt_jax.types import Array


def by_path(tree: Any) -> dict[str, Any]:
    """Leaves by their path, "params/layer0/kernel", in the order of the tree."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def from_paths(like: Any, leaves: dict[str, Any]) -> Any:
    """The tree of the structure of `like` with these leaves, which `by_path` gave."""
    return jax.tree.unflatten(jax.tree.structure(like), [leaves[path] for path in by_path(like)])


def where(condition: Array, a: Any, b: Any) -> Any:
    """`a` where `condition` [] holds, else `b`, leaf by leaf."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)
