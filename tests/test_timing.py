"""Rates: iterations per second, medians, taken in turns."""

from experiments import timing


def test_a_rate_is_iterations_per_second(monkeypatch):
    now = 0.0

    def run(iterations):
        nonlocal now
        now += 0.25 * iterations + (5 if iterations == 1 and now == 0 else 0)

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now)
    assert timing.measure(run, seconds=10, repeats=3) == (4.0, 5.25)


def test_timed_calls_take_turns(monkeypatch):
    now, calls = 0.0, []

    def run(name, seconds_each):
        def once(iterations):
            nonlocal now
            calls.append(name)
            now += seconds_each * iterations

        return once

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now)
    found = timing.measure_in_turns([run("a", 0.5), run("b", 0.25)], seconds=1, repeats=3)
    assert found == [(2.0, 0.5), (4.0, 0.25)]
    assert "".join(calls).endswith("ababab")
