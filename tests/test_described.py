from datetime import UTC, datetime

from experiments.described import default_name


def test_default_name_tells_what_differs():
    now = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)
    assert default_name({}, now) == "20250102T030405Z"
    name = default_name({"preset": "quick", "hidden": (64, 32), "lr": 0.001, "seeds": (0, 1)}, now)
    assert name == "preset=quick_hidden=64+32_lr=0.001_seeds=0+1_20250102T030405Z"
    assert len(default_name({"seeds": tuple(range(1000))}, now)) < 200
