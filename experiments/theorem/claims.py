"""What the tabular experiment shows: a table, and a statement per claim with the numbers it follows from."""

import math
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import stats

from experiments.theorem import contraction
from experiments.theorem.q_learning import Algorithm, Record

ROUNDING = 1e-4  # what float32 may add to a ratio, or put between two programs of the same arithmetic
GAPS = (0.1, 0.01, 0.001)
Names = tuple[str, str]  # MDP, algorithm


class Curves(NamedTuple):
    """One algorithm on one MDP."""

    coefs: tuple[float | None, ...]  # [K]; None: the algorithm has none
    steps: np.ndarray  # [C], the checkpoints
    record: Record  # leaves [seeds, K, C]
    tables: np.ndarray  # [seeds, K, N, S, A], at the end


class Statement(NamedTuple):
    claim: str
    verdict: str  # supported, contradicted or not shown
    evidence: str


def interval(values: np.ndarray) -> tuple[float, float]:
    """The mean over seeds [seeds] and the half width of its 95 % t interval (NaN for one seed)."""
    if len(values) < 2:
        return float(np.mean(values)), math.nan
    width = stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values))
    return float(np.mean(values)), float(width)


def tenth(steps: np.ndarray) -> int:
    """The checkpoint nearest to a tenth of the steps."""
    return int(np.abs(np.log(steps / (0.1 * steps[-1]))).argmin())


def rows(results: Mapping[Names, Curves]) -> Iterator[tuple[Names, int, Curves]]:
    for names, curves in results.items():
        for index in range(len(curves.coefs)):
            yield names, index, curves


def collapsed(curves: Curves) -> bool:
    """Whether an algorithm with several coefficients gave exactly the same with all of them."""
    same = all(bool((leaf == leaf[:, :1]).all()) for leaf in curves.record[:-1])
    return len(curves.coefs) > 1 and same and bool((curves.tables == curves.tables[:, :1]).all())


def along(curves: Curves, index: int) -> np.ndarray:
    """The bias on the way: its mean over the checkpoints, which lie evenly in the logarithm of the steps. [seeds]"""
    return np.asarray(curves.record.bias)[:, index].mean(axis=-1)


def _coef(value: float | None) -> str:
    return "-" if value is None else f"{value:g}"


def _signed(mean: float, width: float) -> str:
    return f"{mean:+.3f}" + ("" if math.isnan(width) else f" ± {width:.3f}")


HEADER = (
    "MDP",
    "algorithm",
    "coef",
    "max error",
    "mean error",
    "bias on the way",
    "bias at the end",
    "std at a tenth",
    "std at the end",
    "largest ratio",
)


def cells(results: Mapping[Names, Curves]) -> list[tuple[str, ...]]:
    found: list[tuple[str, ...]] = []
    for (mdp, algo), k, curves in rows(results):
        record, early = curves.record, tenth(curves.steps)
        several, alike = curves.tables.shape[2] > 1, collapsed(curves)
        if alike and k:
            continue
        found.append(
            (
                mdp,
                algo,
                "all alike" if alike else _coef(curves.coefs[k]),
                f"{record.error_max[:, k, -1].mean():.3f}",
                f"{record.error_mean[:, k, -1].mean():.3f}",
                _signed(*interval(along(curves, k))),
                _signed(*interval(np.asarray(record.bias)[:, k, -1])),
                f"{record.std[:, k, early].mean():.3f}" if several else "-",
                f"{record.std[:, k, -1].mean():.3f}" if several else "-",
                f"{record.ratio[:, k].max():.3f}",
            )
        )
    return found


LEGEND = (
    "Means over seeds; ± is the half width of the 95 % t interval over seeds. Errors are |Q_i - Q*| at the end, over",
    "all tables and pairs. Bias: mean of Q_i - Q*; on the way: its mean over the checkpoints. Std: over tables, mean",
    "over pairs; the penalty is coef times that. Ratio: max |T Q - Q*| / (gamma max |Q_i - Q*|), T the expected",
    "target; the largest over seeds and checkpoints. Eq. 16 wants at most 1.",
    "A statement of a sign is contradicted where the interval of one row lies wholly on the other side of 0; that",
    "there are many intervals is not corrected for.",
)


def verdict_of(intervals: Sequence[tuple[float, float]], sign: int) -> str:
    """Supported where all means have the sign and their intervals with them, contradicted where one has the other."""
    if any(sign * mean + width < 0 for mean, width in intervals):
        return "contradicted"
    clear = [sign * mean - width > 0 for mean, width in intervals]  # False where a single seed gives no interval
    return "supported" if clear and all(clear) else "not shown"


def _row_name(names: Names, coef: float | None) -> str:
    return ", ".join(names) + ("" if coef is None else f" {coef:g}")


def _signs(claim: str, results: Mapping[Names, Curves], wanted: Sequence[str], sign: int) -> Statement:
    """Whether the bias on the way has the sign in all rows of `wanted` algorithms; SQT's with a penalty only."""
    found = {
        _row_name(names, curves.coefs[k]): interval(along(curves, k))
        for names, k, curves in rows(results)
        if names[1] in wanted and curves.coefs[k] != 0
    }
    texts = [f"{name}: {_signed(*row)}" for name, row in found.items()]
    evidence = f"bias on the way: {'; '.join(texts) or 'not run'}."
    other = [name for name, row in found.items() if verdict_of([row], sign) == "contradicted"]
    if other:
        evidence += f" The other way: {'; '.join(other)}."
    return Statement(claim, verdict_of(list(found.values()), sign), evidence)


def overestimation(results: Mapping[Names, Curves]) -> Statement:
    return _signs("Q-learning overestimates (eq. 6)", results, ["q_learning"], +1)


def underestimation(results: Mapping[Names, Curves]) -> Statement:
    return _signs("The minimum and SQT underestimate (eq. 7)", results, ["maxmin", "sqt"], -1)


def monotone(results: Mapping[Names, Curves]) -> Statement:
    texts, found = [], []
    for (mdp, algo), curves in results.items():
        if algo == "sqt" and len(curves.coefs) > 1:
            order = np.argsort(np.array(curves.coefs, float))
            changes = [interval(along(curves, high) - along(curves, low)) for low, high in pairwise(order)]
            found += changes
            texts.append(f"{mdp}: {', '.join(_signed(*change) for change in changes)}")
    evidence = f"change of the bias on the way from each coefficient to the next: {'; '.join(texts) or 'not run'}."
    return Statement("A larger coefficient gives lower values", verdict_of(found, -1), evidence)


def _falls(claim: str, results: Mapping[Names, Curves], quantity: str, algos: Sequence[str]) -> Statement:
    """Whether a quantity is smaller at the end than at a tenth of the steps, in each row."""
    found, fell, members, factors = [], 0, 0, {}
    for names, k, curves in rows(results):
        if names[1] in algos:
            values, early = getattr(curves.record, quantity)[:, k], tenth(curves.steps)
            fell += int((values[:, -1] < values[:, early]).sum())
            members += len(values)
            found.append(interval(values[:, -1] - values[:, early]))
            factors[_row_name(names, curves.coefs[k])] = values[:, -1].mean() / values[:, early].mean()
    if not members:
        return Statement(claim, "not shown", "not run.")
    best, worst = min(factors, key=factors.__getitem__), max(factors, key=factors.__getitem__)
    evidence = (
        f"from a tenth of the steps to the end it falls in {fell} of {members} members; the mean over seeds to between "
        f"{factors[best]:.0%} ({best}) and {factors[worst]:.0%} ({worst}) of what it was."
    )
    return Statement(claim, verdict_of(found, -1), evidence)


def convergence(results: Mapping[Names, Curves]) -> Statement:
    algos = sorted({algo for _, algo in results})
    return _falls("The values approach Q*: max |Q_i - Q*| falls", results, "error_max", algos)


def penalty(results: Mapping[Names, Curves]) -> Statement:
    return _falls("The penalty vanishes (eqs. 12, 14): the std over tables falls", results, "std", ["sqt"])


def identical(results: Mapping[Names, Curves]) -> Statement:
    """SQT whose tables all learn from each transition, beside Q-learning."""
    texts, same = [], []
    for (mdp, algo), curves in results.items():
        if algo != "sqt_shared":
            continue
        std = float(curves.record.std.max())
        text, equal = f"{mdp}: largest std at any checkpoint {std:.3g}", std == 0
        if (mdp, "q_learning") in results:
            plain = results[mdp, "q_learning"].tables
            apart = float(np.abs(curves.tables - plain).max())
            text += f", largest difference to Q-learning's values at the end {apart:.3g}"
            equal = equal and apart <= ROUNDING * float(np.abs(plain).max())
        same.append(equal)
        texts.append(text)
    verdict = "not shown" if not same else "supported" if all(same) else "contradicted"
    claim = "Tables that learn from the same transitions have no penalty, with any coefficient: SQT is Q-learning then"
    return Statement(claim, verdict, ("; ".join(texts) or "not run") + ".")


class Expansion(NamedTuple):
    """Largest |T Q - T Q'| / (gamma max |Q - Q'|) for one coefficient."""

    coef: float
    given: float  # with the next action given
    bound: float  # the same by hand
    choice: float  # with a choice of four
    alike: float  # the same, all tables identical
    ties: tuple[float, ...]  # two actions `GAPS` from a tie


def expansions(algorithm: Algorithm, coefs: Sequence[float], ddof: int, pairs: int) -> list[Expansion]:
    values, count = contraction.values_of(algorithm.rule), algorithm.num_tables
    return [
        Expansion(
            coef,
            contraction.search(values, coef, count, 1, pairs=pairs).ratio,
            contraction.bound(coef, count, ddof),
            contraction.search(values, coef, count, 4, pairs=pairs).ratio,
            contraction.search(values, coef, count, 4, identical=True, pairs=pairs).ratio,
            tuple(contraction.near_tie(values, coef, gap) for gap in GAPS),
        )
        for coef in coefs
    ]


def expansion_table(found: Sequence[Expansion]) -> list[tuple[str, ...]]:
    """With its header first."""
    ties = tuple(f"{gap:g} from a tie" for gap in GAPS)
    header = ("coef", "a' given", "by hand at most", "choice of 4", "identical tables", *ties)
    return [header] + [
        (f"{e.coef:g}", *(f"{x:.4f}" for x in (e.given, e.bound)), f"{e.choice:.4g}", f"{e.alike:.4f}")
        + tuple(f"{x:.4g}" for x in e.ties)
        for e in found
    ]


def non_expansion(found: Sequence[Expansion], num_tables: int, gamma: float, ddof: int, pairs: int) -> Statement:
    """Eq. 16."""
    most = max(found, key=lambda e: e.given)
    wider = max(max(e.choice, *e.ties) for e in found)
    largest = max(most.given, wider)
    verdict = "contradicted" if largest > 1 + ROUNDING else "supported"
    alike = max(e.alike for e in found)
    lines = [
        f"largest |T Q - T Q'| / (gamma max |Q - Q'|), {pairs:,} random pairs of {num_tables} tables: {most.given:.4f} "
        f"at coef {most.coef:g} with the next action given, where it can be {most.bound:.4f}; {wider:.4g} with a "
        f"choice of the next action; {alike:.4f} where the tables are identical."
    ]
    coef = Fraction(most.coef).limit_denominator(1000)
    if coef > 0:
        change, apart = contraction.counter_example(coef)
        one, other = contraction.EXAMPLE
        lines.append(
            f"In exact arithmetic: one state, one action, three tables, ddof 1, coef {coef}. Q = {one} has min 0 and "
            f"std 0, Q' = {other} min -1 and std 1. max |Q - Q'| = {apart}, |T Q - T Q'| = {change} gamma."
        )
        limit = (1 / gamma - 1) / (contraction.bound(1.0, num_tables, ddof) - 1)
        lines.append(
            f"With the next action given, T contracts by some factor below 1 for coef < {limit:.3f} (gamma {gamma:g}, "
            f"{num_tables} tables)."
        )
    return Statement("T is a gamma-contraction in the maximum norm (eq. 16)", verdict, " ".join(lines))


def on_the_way(results: Mapping[Names, Curves]) -> Statement:
    texts, beyond = [], []
    for names, k, curves in rows(results):
        if names[1] == "sqt":
            ratio = curves.record.ratio[:, k]
            above = int((ratio > 1 + ROUNDING).sum())
            beyond.append(above)
            if above:
                name = _row_name(names, curves.coefs[k])
                texts.append(f"{name}: in {above} of {ratio.size}, at most {ratio.max():.3f}")
    verdict = "not shown" if not beyond else "contradicted" if any(beyond) else "supported"
    claim = "While SQT learns, its expected target is nearer to Q* than its tables are, by gamma or more"
    evidence = "max |T Q - Q*| / (gamma max |Q_i - Q*|) is above 1, of seeds times checkpoints: "
    return Statement(claim, verdict, evidence + ("; ".join(texts) or ("nowhere" if beyond else "not run")) + ".")


def markdown_table(lines: Sequence[Sequence[str]]) -> list[str]:
    """The first line is the header."""
    text = [f"| {' | '.join(row)} |" for row in lines]
    return [text[0], "|---" * len(lines[0]) + "|", *text[1:]]


def markdown(
    command: str,
    settings: Sequence[str],
    table: Sequence[Sequence[str]],
    found: Sequence[Statement],
    expansion: Sequence[Sequence[str]],
) -> str:
    lines = ["# The tabular theorem, measured", "", f"By `{command}`.", "", *(f"- {line}" for line in settings), ""]
    lines += ["## Statements", ""]
    lines += [f"- **{s.claim}: {s.verdict}.** {s.evidence[0].upper()}{s.evidence[1:]}" for s in found]
    lines += ["", "## Learning", "", *LEGEND, "", *markdown_table([HEADER, *table])]
    lines += ["", "## Eq. 16", "", "Largest |T Q - T Q'| / (gamma max |Q - Q'|) found.", "", *markdown_table(expansion)]
    return "\n".join(lines) + "\n"
