"""Is SQT's operator a gamma-contraction in the maximum norm, as eq. 16 has it?

An operator T gives one table [S, A] for N of them. With a deterministic next state, no reward and gamma taken out,
(T Q)(s, a) is the value v(Q) that the rule gives to the N x A values of the next state. So the question is whether

    |v(Q) - v(Q')| <= max |Q - Q'|        for all Q and Q', [N, A]

by how much it fails at most, and for which Q and Q'.
"""

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.theorem.q_learning import Rule, Target
from sqt_jax.types import Array

PAIRS = 100_000
Values = Callable[[Array, Array], Array]  # many Q [P, N, A], coef [] -> [P]


class Found(NamedTuple):
    """The largest |v(Q) - v(Q')| / max |Q - Q'| of a search, and where."""

    ratio: float
    one: np.ndarray  # Q [N, A]
    other: np.ndarray  # Q' [N, A]


def values_of(rule: Rule) -> Values:
    """v of many Q at once, compiled once for all coefficients."""

    def value(q: Array, coef: Array) -> Array:
        return rule(Target(jnp.zeros(()), jnp.ones(()), q, jnp.zeros((), jnp.int32), coef, 1.0))

    return jax.jit(jax.vmap(value, in_axes=(0, None)))


def ratios(values: Values, coef: float, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """|v(Q) - v(Q')| / max |Q - Q'| of pairs [P, N, A] of float32: [P]"""
    v, w = (np.asarray(values(jnp.asarray(q), jnp.float32(coef)), np.float64) for q in (one, other))
    return np.abs(v - w) / np.abs(one.astype(np.float64) - other).max(axis=(1, 2))


def search(
    values: Values, coef: float, num_tables: int, num_actions: int, *, identical: bool = False, pairs: int = PAIRS
) -> Found:
    """Random pairs: Q normal, Q' - Q of one size in all entries with random signs, which is where v changes most.

    Args:
      identical: only tables that are all the same, in Q and in Q'.
    """
    generator = np.random.default_rng(0)
    tables = 1 if identical else num_tables
    shape = (pairs, tables, num_actions)
    size, spread = 10.0 ** generator.uniform(-1, 0.5, (2, pairs, 1, 1))  # not too small for float32
    one = spread * generator.normal(size=shape)
    other = one + size * generator.choice([-1.0, 1.0], shape)
    one, other = (np.repeat(q, num_tables // tables, axis=1).astype(np.float32) for q in (one, other))
    found = ratios(values, coef, one, other)
    best = int(found.argmax())
    return Found(float(found[best]), one[best], other[best])


def bound(coef: float, num_tables: int, ddof: int) -> float:
    """The largest ratio where the next action is given, by hand: 1 + coef * 2 sqrt(k (N - k) / (N (N - ddof))).

    The sum of the absolute partial derivatives of min - coef * std is 1 + coef * sum_i |Q_i - mean| / ((N - ddof) std),
    and the sum of deviations is largest beside their squares where k = floor(N / 2) tables agree on a low value and the
    rest on a high one: the low ones fall and the high ones rise together.
    """
    low = num_tables // 2
    return 1 + coef * 2 * math.sqrt(low * (num_tables - low) / (num_tables * (num_tables - ddof)))


def exact_value(q: Sequence[Fraction], coef: Fraction, ddof: int) -> Fraction:
    """min - coef * std without rounding.

    Raises:
      ValueError: the std is not rational.
    """
    mean = sum(q, Fraction(0)) / len(q)
    variance = sum(((x - mean) ** 2 for x in q), Fraction(0)) / (len(q) - ddof)
    std = Fraction(math.isqrt(variance.numerator), math.isqrt(variance.denominator))
    if std * std != variance:
        raise ValueError(f"the square root of {variance} is not rational")
    return min(q) - coef * std


# Three tables, one action, ddof 1: the std of the second is exactly 1, and no entry differs by more than 1.
EXAMPLE = ((0, 0, 0), (-1, 0, 1))


def counter_example(coef: Fraction) -> tuple[Fraction, Fraction]:
    """|v(Q) - v(Q')| and max |Q - Q'| of `EXAMPLE`, in exact arithmetic."""
    one, other = ([Fraction(x) for x in row] for row in EXAMPLE)
    change = abs(exact_value(one, coef, 1) - exact_value(other, coef, 1))
    return change, max(abs(x - y) for x, y in zip(one, other, strict=True))


def near_tie(values: Values, coef: float, gap: float) -> float:
    """|v(Q) - v(Q')| / max |Q - Q'| where two next actions change places in the choice.

    Two tables agree on 0 for the first action. For the second, the better one by `gap`, they say x and x + 2: x is
    `gap` where the choice is by the minimum, `gap` - 1 where it is by the mean. In Q' it is the worse one by `gap`.
    """
    one = np.array([[[0.0, x], [0.0, x + 2.0]] for x in (gap, gap - 1)], np.float32)
    other = one - np.array([0.0, 2 * gap], np.float32)
    return float(ratios(values, coef, one, other).max())
