"""Floating-point operations of an update, and the most that the machine reaches per second.

Only matrix products are counted, 2 m n k each, from the shapes in the traced function. The rest of an update
(activations, Adam) adds a few per cent, and is limited by memory, not by arithmetic.
"""

import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

from experiments.benchmarks.timing import measure
from sqt_jax.types import Agent, State, Transition

# (S, M, K) of the products [S, M, K] @ [S, K, K] that measure the peak: a layer of one member, of several, a large one.
PEAK_SHAPES = ((1, 256, 256), (5, 256, 256), (10, 256, 256), (1, 1024, 1024), (1, 2048, 2048))


def of_update(agent: Agent, state: State, batch: Transition, policy_delay: int) -> float:
    """Operations of one member's update, averaged over updates with and without an actor step.

    Args:
      state: of one member; shapes suffice (`jax.eval_shape`).
      batch: [B, ...], likewise.
      policy_delay: critic updates per actor step.

    Raises:
      ValueError: a matrix product is in a loop of unknown length.
    """
    jaxpr = jax.make_jaxpr(agent.update)(state, batch, jax.random.key(0), jnp.int32(0)).jaxpr
    return _of_products(jaxpr, share=1 / policy_delay)


def _of_products(jaxpr: Any, share: float) -> float:
    """Operations of a jaxpr; a branch (`conditional.apply_if`) counts `share` of its own."""
    total = 0.0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            lengths = [equation.invars[0].aval.shape[axis] for axis in contracted]
            total += 2 * math.prod(equation.outvars[0].aval.shape) * math.prod(lengths)
        elif equation.primitive.name == "while" and not equation.params["cond_jaxpr"].jaxpr.eqns:
            total += share * _of_products(equation.params["body_jaxpr"].jaxpr, share)  # its condition is a given bool
        else:
            inner = sum(_of_products(sub, share) for sub in _inner_jaxprs(equation.params))
            if inner and equation.primitive.name in ("while", "scan"):
                raise ValueError("products in a loop of unknown length cannot be counted")
            total += inner
    return total


def _inner_jaxprs(params: dict[str, Any]) -> Iterator[Any]:
    """The jaxprs among the parameters of an equation."""
    for value in params.values():
        jaxpr = getattr(value, "jaxpr", value)
        if hasattr(jaxpr, "eqns"):
            yield jaxpr


def peak(**timing: Any) -> float:
    """The highest operations per second of float32 matrix products over `PEAK_SHAPES`; `timing` as in `measure`."""
    return max(_rate(shape, **timing) for shape in PEAK_SHAPES)


def _rate(shape: tuple[int, int, int], **timing: Any) -> float:
    count, rows, width = shape
    x = jnp.ones((count, rows, width))
    kernel = jnp.full((count, width, width), 1 / width)

    @jax.jit
    def run(x: jax.Array, kernel: jax.Array, times: int) -> jax.Array:
        return jax.lax.fori_loop(0, times, lambda _, x: x @ kernel, x)

    return 2 * count * rows * width * width * measure(lambda times: run(x, kernel, times), **timing)[0]
