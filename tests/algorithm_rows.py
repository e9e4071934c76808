"""The rows of the table of algorithms, for tests of all of them."""

from collections.abc import Iterable

import pytest

from sqt_jax.algorithms import ALGORITHMS


def first_rows(kind):
    """The first row of each kind: the others differ from it in numbers only, and share what is tested of it."""
    found: dict = {}
    for algo, row in ALGORITHMS.items():
        found.setdefault(kind(row), algo)
    return list(found.values())


KINDS = first_rows(lambda row: (row.make_agent, row.settings.get("penalty")))


def every(names: Iterable[str] = ALGORITHMS):
    """A test of each of these rows; those that differ from another one in sizes alone are slow tests."""
    return pytest.mark.parametrize(
        "algo", [pytest.param(a, marks=[] if a in KINDS else pytest.mark.slow) for a in names]
    )
