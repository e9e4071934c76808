"""Trees of arrays: leaves by path, and selections."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from sqt_jax import trees


class Point(NamedTuple):
    x: object
    y: object


TREE = {"params": {"layer0": {"kernel": np.ones((2, 3)), "bias": np.zeros(3)}}, "points": (Point(1.0, 2.0),)}


def test_leaves_have_paths_in_the_order_of_the_tree():
    paths = ["params/layer0/bias", "params/layer0/kernel", "points/0/x", "points/0/y"]
    assert list(trees.by_path(TREE)) == paths
    assert trees.by_path(TREE)["points/0/y"] == 2.0


def test_from_paths_is_the_inverse_whatever_the_order_of_the_leaves():
    leaves = trees.by_path(TREE)
    back = trees.from_paths(TREE, dict(reversed(leaves.items())))
    assert back["points"] == TREE["points"] and back["params"]["layer0"]["kernel"].shape == (2, 3)
    with pytest.raises(KeyError):
        trees.from_paths(TREE, {"points/0/x": 1.0})


@pytest.mark.parametrize("condition", [True, False])
def test_where_selects_one_of_two_trees(condition):
    a, b = {"x": jnp.ones(2), "y": jnp.zeros(())}, {"x": jnp.zeros(2), "y": jnp.ones(())}
    chosen = trees.where(jnp.array(condition), a, b)
    for name, leaf in (a if condition else b).items():
        np.testing.assert_array_equal(chosen[name], leaf)


def test_strong_leaves_are_arrays_without_weak_types():
    tree = trees.strong({"a": 1.0, "b": jnp.asarray(2), "c": jnp.float32(1) * 2, "d": np.int64(3), "e": True})
    assert [leaf.dtype.name for leaf in tree.values()] == ["float32", "int32", "float32", "int32", "bool"]
    assert not any(leaf.weak_type for leaf in tree.values())
