"""Growth of cost: the varied quantities, and a figure for each."""

import pytest

from experiments.benchmarks import growth, measure_replays
from experiments.benchmarks.measurements import Measurement
from sqt_jax import algorithms


def row(point, rate):
    return Measurement("growth", "", 5, "member updates", rate, 0.0, point=point)


def test_members_critics_and_capacity_are_varied_one_at_a_time(monkeypatch):
    """The points of each line are measured interleaved."""
    made, lines = [], []

    def measure_cases(cases, **timing):
        lines.append([case.measurement.point for case in cases])
        for case in cases:
            case.prepare()
            yield case.measurement

    monkeypatch.setattr(growth, "measure_cases", measure_cases)
    monkeypatch.setattr(growth, "usable_devices", lambda count: 2 * count)
    monkeypatch.setattr(growth, "updates", lambda *case, **settings: made.append((*case, settings)))
    monkeypatch.setattr(measure_replays, "replay_steps", lambda *case: made.append(case))
    rows = list(growth.measure_growth(["td3"], "ant", 5, seconds=0.0, repeats=1))
    assert lines == [
        [("members", "td3", count) for count in growth.MEMBERS],
        [("critics", "td3", count) for count in growth.CRITICS],
        *([("capacity", kind, capacity) for capacity in growth.CAPACITIES] for kind in ("uniform", "lap")),
    ]
    assert ("td3", "ant", 50, 100, {}) in made and ("td3", "ant", 5, 10, {"ensemble_size": 10}) in made
    assert ("lap", "sample", "ant", 1_000_000, 5) in made
    assert [found.point for found in rows] == sum(lines, []) and {found.suite for found in rows} == {"growth"}
    assert (
        rows[5].what == "td3, ant sizes"
        and rows[5].members == 50
        and rows[5].devices == 100
        and rows[8].what == "td3, ant sizes, 10 critics"
    )


def test_a_figure_shows_the_time_of_one_member_at_every_point(tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(growth, "_draw", lambda points, x, y, path: shown.append((points, path.name)))
    rows = [row(("members", "td3", 1), 100.0), row(("members", "td3", 5), 250.0), row(("capacity", "lap", 10), 1e6)]
    growth.draw([*rows, Measurement("loop", "", 5, "env steps", 1.0, 0.0)], tmp_path)
    assert shown == [
        ({"td3": {1: pytest.approx(10.0), 5: pytest.approx(4.0)}}, "growth_members.png"),
        ({"lap": {10: pytest.approx(1.0)}}, "growth_capacity.png"),
    ]


def test_figures_are_pictures_with_every_value_on_the_axis(tmp_path):
    names = algorithms.ALGORITHMS  # more than there are markers
    assert len(names) > len(growth.MARKERS)
    rows = [row(("members", name, count), 100.0 * count) for name in names for count in growth.MEMBERS]
    (path,) = growth.draw(rows, tmp_path / "new")
    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_quantities_that_were_not_varied_are_not_drawn(tmp_path):
    assert growth.draw([Measurement("env", "", 5, "env steps", 1.0, 0.0)], tmp_path / "none") == []
    assert not (tmp_path / "none").exists()
