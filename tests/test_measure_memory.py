"""The peak memory of a run."""

import pytest

from experiments.benchmarks import measure_memory
from experiments.benchmarks.measurements import MEGABYTES
from sqt_jax.config import ConfigError


@pytest.mark.slow
def test_a_larger_replay_adds_its_own_size_once():
    cases = [("td3", "swimmer", 2, capacity, "mujoco") for capacity in (1_000, 2_000_000)]
    small, large = (next(measure_memory.bench_memory(*case)) for case in cases)
    replay = 2 * 2_000_000 * (8 + 2 + 3) * 4 / 1e6
    assert large.unit == MEGABYTES and f"replay {replay:,.0f}" in large.what
    assert replay * 0.9 < large.rate - small.rate < replay * 1.3
    assert large.figure == (f"{large.rate:,.0f}", "MB")


def test_invalid_settings_are_rejected_before_a_process_starts(monkeypatch):
    monkeypatch.setattr(measure_memory, "ProcessPoolExecutor", None)
    with pytest.raises(ConfigError, match="batch_size"):
        next(measure_memory.bench_memory("td3", "swimmer", 2, 1, "mujoco"))
