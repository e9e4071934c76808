"""The parts of a result table: cells, lines, footnotes, and how numbers are written."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

NOTHING = "-"
# A note on every interval of a score: it does not show the optimism of the maximum over evaluations.
NOT_RESAMPLED = "the choice of the score's evaluation is not resampled"


class Cell(NamedTuple):
    """A cell's text and the numbers of its footnotes."""

    lines: tuple[str, ...]
    marks: tuple[int, ...] = ()


class Line(NamedTuple):
    """A line of a table; `published`: not of our runs."""

    cells: list[Cell]
    published: bool = False


class ResultTable(NamedTuple):
    """A table with its caption and footnotes, before a format is chosen."""

    name: str  # of its files
    title: str
    header: list[str]
    sections: list[list[Line]]
    caption: str
    notes: list[str]  # footnotes; the first has number 1
    records: list[dict[str, Any]]  # the unrounded numbers, one per row of the CSV


class Notes:
    """Footnotes in the order of their first use; calling it with texts gives their numbers."""

    def __init__(self, texts: Iterable[str] = ()):
        self.texts = list(texts)

    def __call__(self, *texts: str) -> tuple[int, ...]:
        for text in texts:
            if text not in self.texts:
                self.texts.append(text)
        return tuple(sorted({self.texts.index(text) + 1 for text in texts}))


def number(value: float | None, sign: bool = False) -> str:
    """`4,275`, `65.3` or `0.86`: three significant digits, and all digits before the point. `-` for None and NaN."""
    if value is None or not math.isfinite(value):
        return NOTHING
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2
    return f"{value:{'+' if sign else ''},.{digits}f}"


def interval(low: float | None, high: float | None) -> str:
    """`[3.00, 12.5]`; empty where there is no interval."""
    return "" if low is None or high is None else f"[{number(low)}, {number(high)}]"


def joined(values: Iterable[Any]) -> str:
    """The seeds' values as one field of a CSV."""
    return " ".join(f"{value:.10g}" for value in values)


def finite(value: Any) -> float | None:
    """`value`, or None where it is None, NaN or infinite."""
    return float(value) if value is not None and np.isfinite(value) else None
