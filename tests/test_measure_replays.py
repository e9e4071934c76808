"""Replays: inserts and samples per second."""

import pytest

from experiments.benchmarks import measure_replays

SHORT = {"seconds": 0.0, "repeats": 1}


@pytest.mark.parametrize("kind", measure_replays.REPLAYS)
@pytest.mark.parametrize("what", ["insert", "sample"])
def test_a_replays_measurement_names_what_was_measured(kind, what):
    (row,) = measure_replays.bench_replay(kind, what, "cheetah", 300, 2, **SHORT)
    assert (row.suite, row.what) == ("replay", f"{kind} {what}, cheetah rows, capacity 300")
    assert (row.members, row.unit) == (2, f"{what}s") and row.rate > 0
