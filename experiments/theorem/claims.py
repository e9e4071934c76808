"""The paper's claims about the tabular case: for each a statement, with its verdict and the numbers it follows from."""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from experiments.theorem import contraction
from experiments.theorem.contraction import Expansion
from experiments.theorem.learning_curves import (
    LearningCurves,
    Names,
    bias_during_learning,
    interval,
    row_name,
    rows,
    signed,
    tenth,
)

ROUNDING = 1e-4  # rounding error of a ratio in float32; two programs of the same arithmetic may differ by it
SUPPORTED, CONTRADICTED, NOT_SHOWN = "supported", "contradicted", "not shown"


class Statement(NamedTuple):
    """A claim of the paper, and the study's verdict on it."""

    claim: str
    verdict: str  # supported, contradicted, not shown, or in how many rows it holds
    evidence: str  # the numbers


def side_of(mean: float, width: float, sign: int) -> int:
    """1: the interval mean ± width has the sign, -1: it has the other one, 0: it contains 0 or there is none (NaN)."""
    return 1 if sign * mean - width > 0 else -1 if sign * mean + width < 0 else 0


def verdict_of(intervals: Sequence[tuple[float, float]], sign: int, unit: str = "rows") -> str:
    """In how many of the intervals (mean, half width) a statement about their sign holds.

    `supported` where it holds in all, `contradicted` where all have the other sign, `not shown` where none has a sign.

    Args:
      unit: the things that have an interval each, in the plural.
    """
    sides = [side_of(*row, sign) for row in intervals]
    for side, verdict in ((1, SUPPORTED), (-1, CONTRADICTED), (0, NOT_SHOWN)):
        if all(found == side for found in sides) and (sides or side == 0):
            return verdict
    verdict = f"holds in {sides.count(1)} of {len(sides)} {unit}"
    for side, words in ((-1, "the other way in"), (0, "undecided in")):
        verdict += f", {words} {sides.count(side)}" if side in sides else ""
    return verdict


def _signs(claim: str, results: Mapping[Names, LearningCurves], wanted: Sequence[str], sign: int) -> Statement:
    """Whether the bias during learning has the sign in each row of the `wanted` algorithms; of SQT where coef > 0."""
    found = {
        row_name(names, curves.coefs[k]): interval(bias_during_learning(curves, k))
        for names, k, curves in rows(results)
        if names[1] in wanted and curves.coefs[k] != 0
    }
    texts = [f"{name}: {signed(*row)}" for name, row in found.items()]
    evidence = f"bias during learning: {'; '.join(texts) or 'not run'}."
    for side, words in ((-1, "The other way"), (0, "Undecided")):
        names = [name for name, row in found.items() if side_of(*row, sign) == side]
        evidence += f" {words}: {'; '.join(names)}." if names else ""
    return Statement(claim, verdict_of(list(found.values()), sign), evidence)


def overestimation(results: Mapping[Names, LearningCurves]) -> Statement:
    """Whether Q-learning overestimates (eq. 6)."""
    return _signs("Q-learning overestimates (eq. 6)", results, ["q_learning"], +1)


def underestimation(results: Mapping[Names, LearningCurves]) -> Statement:
    """Whether MaxMin and SQT underestimate (eq. 7)."""
    return _signs("The minimum and SQT underestimate (eq. 7)", results, ["maxmin", "sqt"], -1)


def monotone(results: Mapping[Names, LearningCurves]) -> Statement:
    """Whether SQT's bias falls from each coefficient to the next."""
    texts, found = [], []
    for (mdp, algo), curves in results.items():
        if algo == "sqt" and len(curves.coefs) > 1:
            order = np.argsort(np.array(curves.coefs, float))
            biases = [bias_during_learning(curves, k) for k in order]
            changes = [interval(higher - lower) for lower, higher in pairwise(biases)]
            found += changes
            texts.append(f"{mdp}: {', '.join(signed(*change) for change in changes)}")
    evidence = (
        f"change of the bias during learning, from each coefficient to the next: {'; '.join(texts) or 'not run'}."
    )
    return Statement("A larger coefficient gives lower values", verdict_of(found, -1, "changes"), evidence)


def _falls(claim: str, results: Mapping[Names, LearningCurves], quantity: str, algos: Sequence[str]) -> Statement:
    """Whether a quantity is smaller at the end than at a tenth of the steps, in each row."""
    found, fell, members, factors = [], 0, 0, {}
    for names, k, curves in rows(results):
        if names[1] in algos:
            values, early = getattr(curves.record, quantity)[:, k], tenth(curves.steps)
            fell += int((values[:, -1] < values[:, early]).sum())
            members += len(values)
            found.append(interval(values[:, -1] - values[:, early]))
            factors[row_name(names, curves.coefs[k])] = values[:, -1].mean() / values[:, early].mean()
    if not members:
        return Statement(claim, NOT_SHOWN, "not run.")
    best, worst = min(factors, key=factors.__getitem__), max(factors, key=factors.__getitem__)
    evidence = (
        f"from a tenth of the steps to the end it falls in {fell} of {members} members; its mean over seeds falls to "
        f"between {factors[best]:.0%} ({best}) and {factors[worst]:.0%} ({worst}) of its value there."
    )
    return Statement(claim, verdict_of(found, -1), evidence)


def convergence(results: Mapping[Names, LearningCurves]) -> Statement:
    """Whether the errors fall, for all algorithms."""
    algos = sorted({algo for _, algo in results})
    return _falls("The values approach Q*: max |Q_i - Q*| falls", results, "error_max", algos)


def penalty(results: Mapping[Names, LearningCurves]) -> Statement:
    """Whether the penalty vanishes (eqs. 12, 14)."""
    return _falls("The penalty vanishes (eqs. 12, 14): the std over tables falls", results, "std", ["sqt"])


def identical(results: Mapping[Names, LearningCurves]) -> Statement:
    """Whether SQT equals Q-learning when all its tables learn from each transition."""
    texts, same = [], []
    for (mdp, algo), curves in results.items():
        if algo != "sqt_shared":
            continue
        std = float(curves.record.std.max())
        text, equal = f"{mdp}: largest std at any measurement {std:.3g}", std == 0
        if (mdp, "q_learning") in results:
            plain = results[mdp, "q_learning"].tables
            apart = float(np.abs(curves.tables - plain).max())
            text += f", largest difference to Q-learning's values at the end {apart:.3g}"
            equal = equal and apart <= ROUNDING * float(np.abs(plain).max())
        same.append(equal)
        texts.append(text)
    verdict = NOT_SHOWN if not same else SUPPORTED if all(same) else CONTRADICTED
    claim = "Tables that learn from the same transitions have no penalty, with any coefficient: SQT is Q-learning then"
    return Statement(claim, verdict, ("; ".join(texts) or "not run") + ".")


def non_expansion(found: Sequence[Expansion], num_tables: int, gamma: float, ddof: int, pairs: int) -> Statement:
    """Whether T is a gamma-contraction (eq. 16), by the largest ratios found.

    Args:
      pairs: of tables that were searched.
    """
    most = max(found, key=lambda e: e.given)
    wider = max(max(e.choice, *e.ties) for e in found)
    largest = max(most.given, wider)
    verdict = CONTRADICTED if largest > 1 + ROUNDING else SUPPORTED
    alike = max(e.alike for e in found)
    lines = [
        f"largest |T Q - T Q'| / (gamma max |Q - Q'|), {pairs:,} random pairs of {num_tables} tables: {most.given:.4f} "
        f"at coef {most.coef:g} with a given next action (at most {most.bound:.4f} by hand); {wider:.4g} with a choice "
        f"of the next action; {alike:.4f} where the tables are identical."
    ]
    coef = Fraction(most.coef).limit_denominator(1000)
    if coef > 0:
        change, apart = contraction.counter_example(coef)
        one, other = contraction.EXAMPLE
        lines.append(
            f"In exact arithmetic: one state, one action, three tables, ddof 1, coef {coef}. Q = {one} has min 0 and "
            f"std 0, Q' = {other} has min -1 and std 1. max |Q - Q'| = {apart}, |T Q - T Q'| = {change} gamma."
        )
        limit = (1 / gamma - 1) / (contraction.bound(1.0, num_tables, ddof) - 1)
        lines.append(
            f"With a given next action, T contracts by some factor below 1 for coef < {limit:.3f} (gamma {gamma:g}, "
            f"{num_tables} tables)."
        )
    return Statement("T is a gamma-contraction in the maximum norm (eq. 16)", verdict, " ".join(lines))


def during_learning(results: Mapping[Names, LearningCurves]) -> Statement:
    """Whether eq. 16 holds for the tables that SQT goes through, with Q* as the other tables."""
    texts, beyond = [], []
    for names, k, curves in rows(results):
        if names[1] == "sqt":
            ratio = curves.record.ratio[:, k]
            above = int((ratio > 1 + ROUNDING).sum())
            beyond.append(above)
            if above:
                name = row_name(names, curves.coefs[k])
                texts.append(f"{name}: {above} of {ratio.size}, at most {ratio.max():.3f}")
    verdict = NOT_SHOWN if not beyond else CONTRADICTED if any(beyond) else SUPPORTED
    claim = "While SQT learns, the error of its expected target is at most gamma times that of its tables"
    evidence = "max |T Q - Q*| / (gamma max |Q_i - Q*|) is above 1 in these of all seeds and measurements: "
    return Statement(claim, verdict, evidence + ("; ".join(texts) or ("none" if beyond else "not run")) + ".")
