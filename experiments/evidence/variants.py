"""Baselines and SQT variants, read from the rows of `sqt_jax.algorithms.ALGORITHMS`.

A row names its baseline and its penalty; names are never taken apart. An algorithm that has no row here (its runs were
made by a newer version) counts as its own baseline.
"""

from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.config import AgentConfig

# The penalties of the paper: the batch's mean std (SQT, eq. 20) and the std of each transition (SQT-tuple, eq. 19).
BATCH_STD, TRANSITION_STD = "batch_std", "transition_std"


def baseline_of(algo: str) -> str:
    """The algorithm that `algo` is compared with; the name itself for a baseline and for an unknown algorithm."""
    row = ALGORITHMS.get(algo)
    return row.baseline or algo if row else algo


def penalty_of(algo: str) -> str:
    """The penalty of an algorithm's row. Raises `KeyError` for an unknown algorithm."""
    return ALGORITHMS[algo].settings.get("penalty", AgentConfig.penalty)


def variants_of(baseline: str) -> list[str]:
    """The SQT variants of a baseline, in the order of their rows."""
    return [name for name, row in ALGORITHMS.items() if row.baseline == baseline]


def variant_with(baseline: str, penalty: str) -> str | None:
    """The first SQT variant of a baseline that has this penalty, if there is one."""
    return next((name for name in variants_of(baseline) if penalty_of(name) == penalty), None)
