"""The benchmark's measurements: rows that say what was measured."""

import weakref

import jax
import pytest

from experiments.benchmarks import kernels, measure
from experiments.benchmarks.measure import Case, Failure, Made, Row

SHORT = {"seconds": 0.0, "repeats": 1}


def case(what, run=lambda steps: None, **made):
    return Case(Row("loop", what, 5, "env steps"), lambda: Made(run, **made))


def failing(*_):
    raise ValueError("\n  No memory [/left]\nand more of it")


@pytest.mark.parametrize(
    ("rate", "shown"), [(123_456.7, "123,457"), (99.96, "100"), (12.34, "12.3"), (1.5, "1.5"), (0.0456, "0.0456")]
)
def test_a_low_rate_is_shown_with_three_digits(rate, shown):
    assert Row("checkpoint", "a", 5, "checkpoints", rate).figure == (shown, "checkpoints/s")


def test_a_case_that_fails_is_told_and_the_others_are_measured(monkeypatch):
    monkeypatch.setattr(kernels, "profile", lambda run, steps: [kernels.Kind("dot", steps, 1.0)])
    cases = [Case(Row("loop", "a", 5, "env steps"), failing), case("b", failing), case("c", operations=2.0)]
    unmade, unmeasured, row = measure.in_turns(cases, profiled=True, **SHORT)
    assert unmade == Failure("loop: a, 5 members", "ValueError: No memory [/left]")
    assert unmeasured == Failure("loop: b, 5 members", "ValueError: No memory [/left]")
    assert row.rate > 0 and row.operations == 2.0 and row.kinds == (kernels.Kind("dot", 4, 1.0),)


def test_a_profile_that_fails_loses_no_figure(monkeypatch):
    monkeypatch.setattr(kernels, "profile", failing)
    failed, row = measure.in_turns([case("a", compile_seconds=3.0)], profiled=True, **SHORT)
    assert failed == Failure("profile of loop: a, 5 members", "ValueError: No memory [/left]")
    assert row.rate > 0 and row.compile_seconds == 3.0 and row.kinds is None


@pytest.mark.parametrize(("limit", "most"), [(0, 1), (1e12, 3)])
def test_large_loops_are_on_the_device_one_at_a_time(monkeypatch, limit, most):
    class State:
        """What a loop holds."""

    alive, counts = weakref.WeakSet(), []

    def loop_steps(algo, task, members, physics, devices):
        state = State()
        alive.add(state)

        def run(steps, state=state):
            counts.append(len(alive))
            if physics == "b":
                raise MemoryError(physics)

        return Made(run, compile_seconds=1.0)

    monkeypatch.setattr(measure, "LARGE", limit)
    monkeypatch.setattr(measure, "loop_steps", loop_steps)
    first, failed, last = measure.bench_loops("td3", "cheetah", 5, ["a", "b", "c"], **SHORT)
    assert max(counts) == most and not alive
    assert (first.what, failed.what, last.what) == (
        "td3 on cheetah, a",
        "loop: td3 on cheetah, b, 5 members",
        "td3 on cheetah, c",
    )


def test_fewer_members_than_devices_give_no_row_and_a_line(capsys):
    assert list(measure.bench_updates("td3", "cheetah", 1, (2, 4), **SHORT)) == []
    assert list(measure.bench_loops("td3", "cheetah", 1, ["mjx"], (2,), **SHORT)) == []
    assert capsys.readouterr().out.splitlines() == [
        "no figure of 1 members on 2 or 4 devices: each expects one at least",
        "no figure of 1 members on 2 devices: each expects one at least",
    ]


def test_automatic_devices_are_those_of_a_run(monkeypatch):
    monkeypatch.setattr(measure, "usable_devices", lambda members: 5)
    assert measure.fitting([1, None], 5) == [1, 5]
    assert measure.fitting([5, None, 7], 5) == [5]


@pytest.mark.parametrize("kind", measure.REPLAYS)
@pytest.mark.parametrize("what", ["insert", "sample"])
def test_a_replays_row_names_what_was_measured(kind, what):
    (row,) = measure.bench_replay(kind, what, "cheetah", 300, 2, **SHORT)
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
    (row,) = measure.bench_updates("td3_sqt", "cheetah", 2, **SHORT)
    assert (row.suite, row.what, row.members) == ("update", "td3_sqt, cheetah sizes", 2)
    assert row.unit == "member updates" and row.rate > 0
    assert 4e8 < row.operations < 5e8


@pytest.mark.slow
@pytest.mark.skipif(len(jax.local_devices()) < 2, reason="one device only")
def test_an_update_is_measured_on_each_number_of_devices_that_has_members():
    settings = {"hidden": (16, 16), "batch_size": 16}
    rows = list(measure.bench_updates("td3", "cheetah", 2, (1, 2, 5), settings, **SHORT))
    assert [row.what for row in rows] == ["td3, cheetah sizes", "td3, cheetah sizes, 2 devices"]
    assert [row.devices for row in rows] == [1, 2]
    assert rows[0].operations == rows[1].operations > 0
