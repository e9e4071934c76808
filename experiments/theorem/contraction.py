"""Is SQT's operator a gamma-contraction in the maximum norm, as eq. 16 states?

An operator T maps N tables to one table [S, A]. With a deterministic next state, no reward and gamma divided out,
(T Q)(s, a) is the value v(Q) that the rule gives to the N x A values of the next state. The question is whether

    |v(Q) - v(Q')| <= max |Q - Q'|        for all Q and Q', [N, A]

and otherwise how large the ratio of the two sides can be, and for which Q and Q'.
"""

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.theorem.q_learning import Rule, TabularAlgorithm, value_inputs
from sqt_jax.types import Array

PAIRS = 100_000
GAPS = (0.1, 0.01, 0.001)
Values = Callable[[Array, Array], Array]  # many Q [P, N, A], coef [] -> [P]


class LargestRatio(NamedTuple):
    """The largest |v(Q) - v(Q')| / max |Q - Q'| that a search found, and its pair."""

    ratio: float
    one: np.ndarray  # Q, [N, A]
    other: np.ndarray  # Q', [N, A]


def values_of(rule: Rule) -> Values:
    """v for a batch of Q, compiled once for all coefficients."""

    def value(q: Array, coef: Array) -> Array:
        return rule(value_inputs(q, jnp.zeros((), jnp.int32), coef))

    return jax.jit(jax.vmap(value, in_axes=(0, None)))


def ratios(values: Values, coef: float, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """|v(Q) - v(Q')| / max |Q - Q'| of pairs [P, N, A] of float32: [P]"""
    v, w = (np.asarray(values(jnp.asarray(q), jnp.float32(coef)), np.float64) for q in (one, other))
    return np.abs(v - w) / np.abs(one.astype(np.float64) - other).max(axis=(1, 2))


def search(
    values: Values, coef: float, num_tables: int, num_actions: int, *, identical: bool = False, pairs: int = PAIRS
) -> LargestRatio:
    """Searches random pairs: Q is normal; the entries of Q' - Q have one size and random signs, so that v changes most.

    Args:
      identical: only pairs in which all tables of Q are equal, and all of Q' are.
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
    return LargestRatio(float(found[best]), one[best], other[best])


def bound(coef: float, num_tables: int, ddof: int) -> float:
    """The largest ratio with a given next action, derived by hand: 1 + coef * 2 sqrt(k (N - k) / (N (N - ddof))).

    The sum of the absolute partial derivatives of min - coef * std is 1 + coef * sum_i |Q_i - mean| / ((N - ddof) std).
    Relative to the squared deviations, the sum of deviations is largest where k = floor(N / 2) tables agree on a low
    value and the others on a high one: the low ones fall and the high ones rise together.
    """
    low = num_tables // 2
    return 1 + coef * 2 * math.sqrt(low * (num_tables - low) / (num_tables * (num_tables - ddof)))


def exact_value(q: Sequence[Fraction], coef: Fraction, ddof: int) -> Fraction:
    """min - coef * std in exact arithmetic, for one action; `q` [N].

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
    """|v(Q) - v(Q')| / max |Q - Q'| where the chosen next action changes between Q and Q'.

    Both tables give 0 to the first action and x and x + 2 to the second, which is better by `gap` in Q and worse by
    `gap` in Q': x is `gap` where the choice is by the minimum, `gap` - 1 where it is by the mean.
    """
    one = np.array([[[0.0, x], [0.0, x + 2.0]] for x in (gap, gap - 1)], np.float32)
    other = one - np.array([0.0, 2 * gap], np.float32)
    return float(ratios(values, coef, one, other).max())


class Expansion(NamedTuple):
    """Largest |T Q - T Q'| / (gamma max |Q - Q'|) for one coefficient."""

    coef: float
    given: float  # found with a given next action
    bound: float  # the most that this can be, derived by hand
    choice: float  # found with a choice of four next actions
    alike: float  # found with a choice of four, all tables identical
    ties: tuple[float, ...]  # two next actions, each of `GAPS` from a tie


def expansions(algorithm: TabularAlgorithm, coefs: Sequence[float], ddof: int, pairs: int) -> list[Expansion]:
    """The largest ratios for each coefficient, in searches over `pairs` random pairs each."""
    values, count = values_of(algorithm.rule), algorithm.num_tables
    return [
        Expansion(
            coef=coef,
            given=search(values, coef, count, 1, pairs=pairs).ratio,
            bound=bound(coef, count, ddof),
            choice=search(values, coef, count, 4, pairs=pairs).ratio,
            alike=search(values, coef, count, 4, identical=True, pairs=pairs).ratio,
            ties=tuple(near_tie(values, coef, gap) for gap in GAPS),
        )
        for coef in coefs
    ]
