"""`cond_if_any` has the values of a select under any nesting of vmap, and runs its branch only if an entry needs it.

`any_in_batch` is one answer for a whole batch.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sqt_jax.conditional import any_in_batch, cond_if_any


def branch(old, given):
    a, b = old
    return a * given, b - 1


def step(predicate, old, given):
    return cond_if_any(predicate, branch, old, given=given)


def selected(predicate, old, given):
    return jax.tree.map(lambda a, b: jnp.where(predicate, a, b), branch(old, given), old)


def arguments(*shape):
    generator = np.random.default_rng(0)
    old = (jnp.float32(generator.normal(size=(*shape, 3))), jnp.arange(np.prod(shape, dtype=int)).reshape(shape))
    return jnp.asarray(generator.random(shape) < 0.4), old, jnp.float32(generator.normal(size=(*shape, 1)))


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@pytest.mark.parametrize("shape", [(), (5,), (4, 3), (2, 3, 2)])
def test_it_is_a_selection_under_any_nesting_of_vmap(shape, maybe_jit):
    ours, expected = step, selected
    for _ in shape:
        ours, expected = jax.vmap(ours), jax.vmap(expected)
    args = arguments(*shape)
    assert same(maybe_jit(ours)(*args), expected(*args))
    for value in (True, False):
        everywhere = (jnp.full(shape, value), *args[1:])
        assert same(maybe_jit(ours)(*everywhere), expected(*everywhere))


def test_unbatched_arguments_are_shared():
    predicate, old, given = arguments(6)
    one = jax.tree.map(lambda leaf: leaf[0], old)
    assert same(
        jax.vmap(step, (0, None, None))(predicate, one, given[0]),
        jax.vmap(selected, (0, None, None))(predicate, one, given[0]),
    )
    assert same(
        jax.vmap(step, (None, 0, 0))(jnp.array(True), old, given),
        jax.vmap(selected, (None, 0, 0))(jnp.array(True), old, given),
    )


def test_the_compiled_loop_has_a_real_branch_that_copies_nothing():
    """A loop in the loop, and no select or copy of the state outside."""

    def loop(old, given):
        def body(i, old):
            return jax.vmap(jax.vmap(lambda old, given: step(i + given[0] > 100, old, given)))(old, given)

        return jax.lax.fori_loop(0, 10, body, old)

    _, old, given = arguments(4, 3)
    text = jax.jit(loop).lower(old, given).compile().as_text()
    assert len(re.findall(r" while\(", text)) == 2 and " conditional(" not in text
    # In the outer loop's body only the branch's result and its forwarding have the state's shape.
    around = [part for part in text.split("\n\n") if " while(" in part and "ENTRY" not in part]
    kinds = set(re.findall(r"= f32\[4,3,3\]\S* ([\w-]+)\(", "".join(around)))
    assert kinds <= {"get-tuple-element", "parameter"}, kinds


def test_the_branch_runs_only_if_the_predicate_holds_for_an_entry():
    runs = []

    def counted(old, given):
        jax.debug.callback(lambda: runs.append(1))
        return old + 1

    def at(predicate):
        out = jax.jit(jax.vmap(lambda p, old: cond_if_any(p, counted, old)))(predicate, jnp.zeros(4))
        jax.effects_barrier()
        return out.tolist()

    assert at(jnp.zeros(4, bool)) == [0, 0, 0, 0] and not runs
    assert at(jnp.arange(4) == 2) == [0, 0, 1, 0] and runs


def test_derivatives_are_forward_only():
    def double(x):
        return cond_if_any(x > 0, lambda old, given: 2 * old, x)

    assert jax.jvp(double, (1.0,), (1.0,)) == (2.0, 2.0)
    with pytest.raises(ValueError, match="reverse-mode"):
        jax.grad(double)(1.0)


def test_any_in_batch_is_one_answer_for_all():
    flags = jnp.array([[False, False], [True, False]])
    inner = jax.vmap(any_in_batch, out_axes=None)
    assert not inner(flags[0]) and inner(flags[1])
    outer = jax.vmap(jax.vmap(any_in_batch, out_axes=None), out_axes=None)
    assert outer(flags) and not outer(flags[:1])


def test_a_loop_on_any_in_batch_is_not_selected_for_each_entry():
    def count(limit):
        return jax.lax.while_loop(lambda n: any_in_batch(n < limit), lambda n: n + 1, jnp.zeros((), jnp.int32))

    counts = jax.vmap(count)(jnp.array([1, 5, 3]))
    np.testing.assert_array_equal(counts, [5, 5, 5])
