"""The results of the tabular study as tables and text, for the terminal and for table.md."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from experiments.theorem.claims import Statement
from experiments.theorem.contraction import GAPS, Expansion
from experiments.theorem.learning_curves import (
    LearningCurves,
    Names,
    bias_during_learning,
    collapsed,
    interval,
    rows,
    signed,
    tenth,
)

HEADER = (
    "MDP",
    "algorithm",
    "coef",
    "max error",
    "mean error",
    "bias during learning",
    "bias at the end",
    "std at a tenth",
    "std at the end",
    "largest ratio",
)


def learning_rows(results: Mapping[Names, LearningCurves]) -> list[tuple[str, ...]]:
    """A row of texts below `HEADER` per MDP, algorithm and coefficient."""
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
                "all alike" if alike else "-" if curves.coefs[k] is None else f"{curves.coefs[k]:g}",
                f"{record.error_max[:, k, -1].mean():.3f}",
                f"{record.error_mean[:, k, -1].mean():.3f}",
                signed(*interval(bias_during_learning(curves, k))),
                signed(*interval(np.asarray(record.bias)[:, k, -1])),
                f"{record.std[:, k, early].mean():.3f}" if several else "-",
                f"{record.std[:, k, -1].mean():.3f}" if several else "-",
                f"{record.ratio[:, k].max():.3f}",
            )
        )
    return found


LEGEND = (
    "Means over seeds; ± is the half width of the 95 % t interval over seeds. Errors: |Q_i - Q*| at the end, over all",
    "tables and pairs. Bias: mean of Q_i - Q*; during learning: its mean over the measurements. Std: over tables, with",
    "the penalty's ddof, mean over pairs; the penalty is coef times that. Ratio: max |T Q - Q*| divided by",
    "gamma max |Q_i - Q*|, T the expected target; the largest over seeds and measurements. Eq. 16 requires at most 1.",
    "A statement about a sign holds in a row whose interval is on the stated side of 0, and is undecided in a row",
    "whose interval contains 0. That there are many intervals is not corrected for.",
)


def expansion_table(found: Sequence[Expansion]) -> list[tuple[str, ...]]:
    """A table of `Expansion`s as rows of texts; the first is the header."""
    ties = tuple(f"{gap:g} from a tie" for gap in GAPS)
    header = ("coef", "a' given", "by hand at most", "choice of 4", "identical tables", *ties)
    return [header] + [
        (f"{e.coef:g}", *(f"{x:.4f}" for x in (e.given, e.bound)), f"{e.choice:.4g}", f"{e.alike:.4f}")
        + tuple(f"{x:.4g}" for x in e.ties)
        for e in found
    ]


def terminal_table(lines: Sequence[Sequence[str]], left: int) -> Table:
    """A table for the terminal; the first of `lines` is its header.

    Args:
      left: the number of columns with words, aligned to the left. A new word in the first one begins a section.
    """
    shown = Table(box=SIMPLE_HEAD)
    for index, name in enumerate(lines[0]):
        shown.add_column(name.replace(" ", "\n"), justify="left" if index < left else "right", no_wrap=True)
    before = lines[1][0] if len(lines) > 1 else ""
    for row in lines[1:]:
        if left and row[0] != before:
            shown.add_section()
        before = row[0]
        shown.add_row(*row)
    return shown


def print_statements(console: Console, found: Sequence[Statement]) -> None:
    """Prints claims, coloured verdicts and evidence."""
    colours = {"supported": "green", "contradicted": "red"}
    for statement in found:
        colour = colours.get(statement.verdict, "yellow")
        text = f"\n[bold]{escape(statement.claim)}: [{colour}]{statement.verdict}[/{colour}][/bold]"
        console.print(f"{text}\n  {escape(statement.evidence)}", highlight=False)


def markdown_table(lines: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table; the first of `lines` is its header."""
    text = [f"| {' | '.join(row)} |" for row in lines]
    return [text[0], "|---" * len(lines[0]) + "|", *text[1:]]


def markdown(
    command: str,
    settings: Sequence[str],
    table: Sequence[Sequence[str]],
    found: Sequence[Statement],
    expansion: Sequence[Sequence[str]],
) -> str:
    """The text of table.md."""
    lines = ["# The tabular theorem, measured", "", f"By `{command}`.", "", *(f"- {line}" for line in settings), ""]
    lines += ["## Statements", ""]
    lines += [f"- **{s.claim}: {s.verdict}.** {s.evidence[0].upper()}{s.evidence[1:]}" for s in found]
    lines += ["", "## Learning", "", *LEGEND, "", *markdown_table([HEADER, *table])]
    lines += ["", "## Eq. 16", "", "Largest |T Q - T Q'| / (gamma max |Q - Q'|) found.", "", *markdown_table(expansion)]
    return "\n".join(lines) + "\n"
