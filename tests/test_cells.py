"""Numbers and footnotes of result tables."""

import pytest

from experiments.evidence.cells import Notes, finite, interval, joined, number

NAN = float("nan")


@pytest.mark.parametrize(
    ("value", "text"),
    [(4275.4, "4,275"), (65.34, "65.3"), (-0.861, "-0.86"), (100.0, "100"), (None, "-"), (NAN, "-")],
)
def test_numbers(value, text):
    assert number(value) == text


def test_unknown_values_are_not_shown_as_numbers():
    assert interval(3.0, 12.5) == "[3.00, 12.5]" and interval(None, 1.0) == interval(1.0, None) == ""
    assert finite(2) == 2.0 and finite(NAN) is finite(float("inf")) is finite(None) is None
    assert joined([4.0, 0.125, 12345678.5]) == "4 0.125 12345678.5"


def test_footnotes_are_numbered_in_order_of_first_use():
    notes = Notes(["first"])
    assert notes("second", "first") == (1, 2) and notes("second", "second") == (2,) and notes() == ()
    assert notes.texts == ["first", "second"]
