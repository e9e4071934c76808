"""The benchmark measures what it says: rates per second, rows of every suite, wrong values told in one line."""

import json

import jax
import pytest
from absl.testing import flagsaver

from experiments import bench

SHORT = {"seconds": 0.0, "repeats": 1}


def test_a_rate_is_iterations_per_second(monkeypatch):
    now = 0.0

    def run(iterations):
        nonlocal now
        now += 0.25 * iterations + (5 if iterations == 1 and now == 0 else 0)

    monkeypatch.setattr(bench.time, "perf_counter", lambda: now)
    assert bench.measure(run, seconds=10, repeats=3) == (4.0, 5.25)


@pytest.mark.parametrize("kind", bench.REPLAYS)
@pytest.mark.parametrize("what", ["insert", "sample"])
def test_a_replays_row_names_what_was_measured(kind, what):
    row = bench.bench_replay(kind, what, "cheetah", 300, 2, **SHORT)
    assert (row.suite, row.what) == ("replay", f"{kind} {what}, cheetah rows, capacity 300")
    assert (row.members, row.unit) == (2, f"{what}s") and row.rate > 0


def test_an_updates_row_counts_the_updates_of_all_members():
    row = bench.bench_update("td7_sqt", "cheetah", 2, **SHORT)
    assert (row.suite, row.what, row.members) == ("update", "td7_sqt, cheetah sizes", 2)
    assert row.unit == "member updates" and row.rate > 0


def test_the_table_and_the_file_hold_every_row(monkeypatch, tmp_path, capsys):
    found = [
        bench.Row("env", task, members, "env steps", 1234.5, 6.78) for task in ("ant", "walker") for members in (1, 5)
    ]
    monkeypatch.setattr(bench, "rows", lambda suites, **timing: found)
    monkeypatch.setattr(bench.runtime, "prepare", lambda: None)
    cached = jax.config.jax_enable_compilation_cache
    try:
        with flagsaver.flagsaver(json=str(tmp_path / "bench.json")):
            bench.FLAGS.mark_as_parsed()
            bench.main(["bench"])
    finally:
        jax.config.update("jax_enable_compilation_cache", cached)
    text = capsys.readouterr().out
    assert text.count("| env | ") == 4 and "| env | ant | 5 | 1,234 | env steps/s | 6.8 |" in text
    report = json.loads((tmp_path / "bench.json").read_text())
    assert len(report["rows"]) == 4 and report["machine"]["jax"] == jax.__version__


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("suites", "all"),
        ("tasks", "hopper2"),
        ("algos", "td8"),
        ("physics", "x"),
        ("members", "0"),
        ("capacities", "x"),
    ],
)
def test_a_wrong_name_is_told_in_one_line_before_anything_runs(flag, value):
    bench.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(**{flag: [value]}), pytest.raises(SystemExit) as error:
        bench.main(["bench"])
    message = str(error.value)
    assert message.startswith(f"--{flag}: takes ") and value in message and "\n" not in message
