"""The rows of the table of algorithms, for tests of all of them."""

from collections.abc import Iterable

import pytest

from sqt_jax.algorithms import ALGORITHMS, default_agent_config, features_of
from sqt_jax.config import SETTINGS


def first_rows(kind):
    """The first row of each kind; the others differ from it in numbers only."""
    found: dict = {}
    for algo, row in ALGORITHMS.items():
        found.setdefault(kind(row), algo)
    return list(found.values())


KINDS = first_rows(lambda row: (row.build, row.settings.get("penalty")))


def has_effect(algo, setting) -> bool:
    """Whether a setting has an effect with an algorithm's own settings."""
    return set(SETTINGS[setting].features) <= features_of(ALGORITHMS[algo], default_agent_config(algo))


ONE_OF_EACH = ("td3", "sac_sqt", "td7_sqt_tuple")  # each agent and each penalty


def every(names: Iterable[str] = ALGORITHMS, fast: Iterable[str] = KINDS):
    """A test of each of these rows; by default, rows that differ from another one in sizes only are slow tests.

    `fast` are those that are not slow.
    """
    return pytest.mark.parametrize(
        "algo", [pytest.param(a, marks=[] if a in fast else pytest.mark.slow) for a in names]
    )
