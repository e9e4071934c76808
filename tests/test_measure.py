"""The benchmark's measurements: rows that say what was measured."""

import jax
import pytest

from experiments import measure

SHORT = {"seconds": 0.0, "repeats": 1}


@pytest.mark.parametrize("kind", measure.REPLAYS)
@pytest.mark.parametrize("what", ["insert", "sample"])
def test_a_replays_row_names_what_was_measured(kind, what):
    row = measure.bench_replay(kind, what, "cheetah", 300, 2, **SHORT)
    assert (row.suite, row.what) == ("replay", f"{kind} {what}, cheetah rows, capacity 300")
    assert (row.members, row.unit) == (2, f"{what}s") and row.rate > 0


@pytest.mark.parametrize("task", ["swimmer", "humanoid"])
def test_mujoco_alone_steps_with_and_without_contact_forces(task, monkeypatch):
    made = []
    original = measure.mujoco.mj_rnePostConstraint
    monkeypatch.setattr(measure.mujoco, "mj_rnePostConstraint", lambda *args: made.append(original(*args)))
    measure.bare_steps(task, 3)(2)
    assert len(made) == (6 if task == "humanoid" else 0)


def test_an_updates_row_counts_the_updates_of_all_members():
    (row,) = measure.bench_updates("td7_sqt", "cheetah", 2, **SHORT)
    assert (row.suite, row.what, row.members) == ("update", "td7_sqt, cheetah sizes", 2)
    assert row.unit == "member updates" and row.rate > 0
    assert 2e9 < row.operations < 3e9


@pytest.mark.skipif(len(jax.local_devices()) < 2, reason="one device only")
def test_an_update_is_measured_on_each_number_of_devices_that_has_members():
    settings = {"hidden": (16, 16), "batch_size": 16}
    rows = list(measure.bench_updates("td3", "cheetah", 2, (1, 2, 5), settings, **SHORT))
    assert [row.what for row in rows] == ["td3, cheetah sizes", "td3, cheetah sizes, 2 devices"]
    assert rows[0].operations == rows[1].operations > 0
