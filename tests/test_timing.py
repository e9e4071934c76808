"""Rates: iterations per second, medians, interleaved."""

import pytest

from experiments.benchmarks import timing


def test_a_rate_is_iterations_per_second(monkeypatch):
    now = 0.0

    def run(iterations):
        nonlocal now
        now += 0.25 * iterations + (5 if iterations == 1 and now == 0 else 0)

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now)
    assert timing.measure(run, seconds=10, repeats=3) == (4.0, 5.25)


def test_timed_calls_are_interleaved(monkeypatch):
    now, calls = 0.0, []

    def run(name, seconds_each):
        def once(iterations):
            nonlocal now
            calls.append(name)
            now += seconds_each * iterations

        return once

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now)
    found = timing.measure_interleaved([run("a", 0.5), run("b", 0.25)], seconds=1, repeats=3)
    assert found == [(2.0, 0.5), (4.0, 0.25)]
    assert "".join(calls).endswith("ababab")


def test_a_loop_that_fails_is_left_out_and_the_others_are_measured(monkeypatch):
    now, calls = 0.0, {"a": 0, "b": 0, "c": 0}

    def run(name, last):
        def once(iterations):
            nonlocal now
            calls[name] += 1
            if calls[name] == last:
                raise ValueError(name)
            now += iterations

        return once

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now)
    first, second, third = timing.rates_or_errors([run("a", 1), run("b", None), run("c", 4)], seconds=1, repeats=3)
    assert second == timing.Timed((1.0, 1.0, 1.0), 1.0) and calls == {"a": 1, "b": 5, "c": 4}
    assert (str(first), str(third)) == ("a", "c")
    assert first.__traceback__ is None  # whose frames would keep arrays


def test_one_measurement_raises_its_runs_exception():
    with pytest.raises(ZeroDivisionError):
        timing.measure(lambda iterations: 1 // 0, seconds=1, repeats=1)
