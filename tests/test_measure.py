"""The benchmark's measurements: rates per second, and rows that say what was measured."""

import pytest

from experiments import measure

SHORT = {"seconds": 0.0, "repeats": 1}


def test_a_rate_is_iterations_per_second(monkeypatch):
    now = 0.0

    def run(iterations):
        nonlocal now
        now += 0.25 * iterations + (5 if iterations == 1 and now == 0 else 0)

    monkeypatch.setattr(measure.time, "perf_counter", lambda: now)
    assert measure.measure(run, seconds=10, repeats=3) == (4.0, 5.25)


@pytest.mark.parametrize("kind", measure.REPLAYS)
@pytest.mark.parametrize("what", ["insert", "sample"])
def test_a_replays_row_names_what_was_measured(kind, what):
    row = measure.bench_replay(kind, what, "cheetah", 300, 2, **SHORT)
    assert (row.suite, row.what) == ("replay", f"{kind} {what}, cheetah rows, capacity 300")
    assert (row.members, row.unit) == (2, f"{what}s") and row.rate > 0


@pytest.mark.parametrize("task", ["swimmer", "humanoid"])
def test_mujoco_alone_is_measured_with_and_without_contact_forces(task):
    row = measure.bench_bare(task, 3, **SHORT)
    assert (row.suite, row.what, row.members) == ("physics", f"{task}, MuJoCo alone", 3) and row.rate > 0


def test_an_updates_row_counts_the_updates_of_all_members():
    row = measure.bench_update("td7_sqt", "cheetah", 2, **SHORT)
    assert (row.suite, row.what, row.members) == ("update", "td7_sqt, cheetah sizes", 2)
    assert row.unit == "member updates" and row.rate > 0
