"""What tables are made of: cells, lines, footnotes, and how a number is written."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

NOTHING = "-"
# Of every interval of a score: the maximum over evaluations is optimistic, and the interval does not show it.
NOT_RESAMPLED = "that the score's evaluation was chosen is not resampled"


class Cell(NamedTuple):
    lines: tuple[str, ...]
    marks: tuple[int, ...] = ()  # footnotes


class Line(NamedTuple):
    cells: list[Cell]
    published: bool = False


class Table(NamedTuple):
    name: str  # of its files
    title: str
    header: list[str]
    sections: list[list[Line]]
    caption: str
    notes: list[str]  # footnotes, the first is number 1
    records: list[dict[str, Any]]  # the full numbers, a row of the CSV each


class Notes:
    """Footnotes in the order in which they are first referred to."""

    def __init__(self, texts: Iterable[str] = ()):
        self.texts = list(texts)

    def __call__(self, *texts: str) -> tuple[int, ...]:
        for text in texts:
            if text not in self.texts:
                self.texts.append(text)
        return tuple(sorted({self.texts.index(text) + 1 for text in texts}))


def number(value: float | None, sign: bool = False) -> str:
    """`4,275`, `65.3` or `0.86`: three digits or all before the point."""
    if value is None or not math.isfinite(value):
        return NOTHING
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2
    return f"{value:{'+' if sign else ''},.{digits}f}"


def interval(low: float | None, high: float | None) -> str:
    """In brackets; nothing where there is none."""
    return "" if low is None or high is None else f"[{number(low)}, {number(high)}]"


def joined(values: Iterable[Any]) -> str:
    """Numbers of the seeds, for one field of a CSV."""
    return " ".join(f"{value:.10g}" for value in values)


def finite(value: Any) -> float | None:
    return float(value) if value is not None and np.isfinite(value) else None
