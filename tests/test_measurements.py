"""Cases are measured together; one that fails is reported, and the others are measured."""

import pytest

from experiments.benchmarks import kernels, measurements
from experiments.benchmarks.measurements import Case, Failure, Measurement, Prepared

SHORT = {"seconds": 0.0, "repeats": 1}


def case(what, run=lambda steps: None, **made):
    return Case(Measurement("loop", what, 5, "env steps"), lambda: Prepared(run, **made))


def failing(*_):
    raise ValueError("\n  No memory [/left]\nand more of it")


@pytest.mark.parametrize(
    ("rate", "shown"), [(123_456.7, "123,457"), (99.96, "100"), (12.34, "12.3"), (1.5, "1.5"), (0.0456, "0.0456")]
)
def test_a_low_rate_is_shown_with_three_digits(rate, shown):
    assert Measurement("checkpoint", "a", 5, "checkpoints", rate).figure == (shown, "checkpoints/s")


def test_a_case_that_fails_is_reported_and_the_others_are_measured(monkeypatch):
    monkeypatch.setattr(kernels, "profile", lambda run, steps: [kernels.Kind("dot", steps, 1.0)])
    cases = [Case(Measurement("loop", "a", 5, "env steps"), failing), case("b", failing), case("c", operations=2.0)]
    unmade, unmeasured, row = measurements.measure_cases(cases, profiled=True, **SHORT)
    assert unmade == Failure("loop: a, 5 members", "ValueError: No memory [/left]")
    assert unmeasured == Failure("loop: b, 5 members", "ValueError: No memory [/left]")
    assert row.rate > 0 and row.operations == 2.0 and row.kinds == (kernels.Kind("dot", 4, 1.0),)


def test_a_profile_that_fails_loses_no_measurement(monkeypatch):
    monkeypatch.setattr(kernels, "profile", failing)
    failed, row = measurements.measure_cases([case("a", compile_seconds=3.0)], profiled=True, **SHORT)
    assert failed == Failure("profile of loop: a, 5 members", "ValueError: No memory [/left]")
    assert row.rate > 0 and row.compile_seconds == 3.0 and row.kinds is None


def test_automatic_devices_are_those_of_a_run(monkeypatch):
    monkeypatch.setattr(measurements, "usable_devices", lambda members: 5)
    assert measurements.device_counts([1, None], 5) == [1, 5]
    assert measurements.device_counts([5, None, 7], 5) == [5]
