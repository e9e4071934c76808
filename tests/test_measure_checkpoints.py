"""The cost of checkpoints."""

import pytest

from experiments.benchmarks import measure_checkpoints


@pytest.mark.slow
def test_a_first_and_a_later_checkpoint_and_the_wait_of_training_are_timed(monkeypatch):
    monkeypatch.setattr(measure_checkpoints, "FILLED", 40)
    monkeypatch.setattr(measure_checkpoints, "NEW", 10)
    monkeypatch.setattr(
        measure_checkpoints.experiment, "make_config", small(measure_checkpoints.experiment.make_config)
    )
    rows = list(measure_checkpoints.bench_checkpoint("td3", "hopper", 2, 1))
    assert [row.what for row in rows] == [
        "td3, hopper, all 40 rows, 0 MB",
        "td3, hopper, 10 new rows",
        "td3, hopper, 10 new rows, until training continues",
    ]
    assert all(row.rate > 0 and row.members == 2 for row in rows)
    assert rows[2].rate >= rows[1].rate


def small(make_config):
    return lambda *names, **settings: make_config(
        *names, **settings | {"hidden": (8, 8), "batch_size": 8, "steps": 40, "warmup_steps": 10}
    )
