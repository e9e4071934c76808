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


def test_timed_calls_take_turns(monkeypatch):
    now, calls = 0.0, []

    def run(name, seconds_each):
        def once(iterations):
            nonlocal now
            calls.append(name)
            now += seconds_each * iterations

        return once

    monkeypatch.setattr(measure.time, "perf_counter", lambda: now)
    found = measure.measure_in_turns([run("a", 0.5), run("b", 0.25)], seconds=1, repeats=3)
    assert found == [(2.0, 0.5), (4.0, 0.25)]
    assert "".join(calls).endswith("ababab")


@pytest.mark.parametrize("task", ["swimmer", "humanoid"])
def test_mujoco_alone_steps_with_and_without_contact_forces(task, monkeypatch):
    made = []
    original = measure.mujoco.mj_rnePostConstraint
    monkeypatch.setattr(measure.mujoco, "mj_rnePostConstraint", lambda *args: made.append(original(*args)))
    measure.bare_steps(task, 3)(2)
    assert len(made) == (6 if task == "humanoid" else 0)


def test_an_updates_row_counts_the_updates_of_all_members():
    row = measure.bench_update("td7_sqt", "cheetah", 2, **SHORT)
    assert (row.suite, row.what, row.members) == ("update", "td7_sqt, cheetah sizes", 2)
    assert row.unit == "member updates" and row.rate > 0
