"""The benchmark measures what it says: rates per second, rows of every suite, wrong values told in one line."""

import json

import jax
import pytest
from absl.testing import flagsaver

from experiments import bench
from sqt_jax.envs import physics


def test_ratios_are_those_of_one_task_and_number_of_members():
    rates = {"MuJoCo alone": 100.0, "mujoco": 90.0, "mjx": 50.0, "mjx, the file's iterations": 20.0}
    rows = [bench.Row("physics", f"ant, {what}", 5, "env steps", rate, 0.0) for what, rate in rates.items()]
    loops = {"td3 on ant, mjx": 200.0, "td3 on ant, mujoco": 250.0, "td3 on walker, mujoco": 300.0}
    rows += [bench.Row("loop", what, 5, "env steps", rate, 0.0) for what, rate in loops.items()]
    assert bench.ratios(rows) == [
        "ant, 5 members: mujoco / MuJoCo alone = 0.90",
        "ant, 5 members: mjx / mjx, the file's iterations = 2.50",
        "td3 on ant, 5 members: mujoco / mjx = 1.25",
    ]


def test_the_table_and_the_file_hold_every_row(monkeypatch, tmp_path, capsys):
    found = [
        bench.Row("env", task, members, "env steps", 1234.5, 6.78) for task in ("ant", "walker") for members in (1, 5)
    ]
    monkeypatch.setattr(bench, "rows", lambda suites, physics, environment, **timing: found)
    monkeypatch.setattr(bench.runtime, "prepare", lambda: None)
    cached = jax.config.jax_enable_compilation_cache
    try:
        with flagsaver.flagsaver(json=str(tmp_path / "bench.json")):
            bench.FLAGS.mark_as_parsed()
            bench.main(["bench"])
    finally:
        jax.config.update("jax_enable_compilation_cache", cached)
    text = capsys.readouterr().out
    assert text.count("| env | ") == 4 and "| env | ant | 5 | 1,234 | env steps/s | 6.8 |  |  |" in text
    report = json.loads((tmp_path / "bench.json").read_text())
    assert len(report["rows"]) == 4 and report["machine"]["jax"] == jax.__version__


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("suites", "all"),
        ("tasks", "hopper2"),
        ("algos", "td8"),
        ("physics", "x"),
        ("solver", "8"),
        ("solver", "8/0"),
        ("members", "0"),
        ("capacities", "x"),
        ("devices", "0"),
        ("compare", "cleanrl"),
    ],
)
def test_a_wrong_name_is_told_in_one_line_before_anything_runs(flag, value):
    bench.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(**{flag: [value]}), pytest.raises(SystemExit) as error:
        bench.main(["bench"])
    message = str(error.value)
    assert message.startswith(f"--{flag}: takes ") and value in message and "\n" not in message


def test_physics_that_cannot_run_here_are_left_out_or_refused(monkeypatch):
    monkeypatch.setitem(physics.LACKS, "warp", lambda: "a part")
    bench.FLAGS.mark_as_parsed()
    assert bench.physics_here() == ["mjx", "mujoco"]
    with flagsaver.flagsaver(physics=["warp"]), pytest.raises(SystemExit, match="^--physics: warp needs a part$"):
        bench.physics_here()


def test_a_suite_by_name_sets_the_flags_that_were_not_given():
    bench.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(suite="gpu"), flagsaver.flagsaver():
        bench.FLAGS["tasks"].present = 1
        try:
            bench.check_flags()
            assert bench.FLAGS.members == ["5", "64", "512"] and bench.FLAGS.algos == ["td3", "td7"]
            assert bench.FLAGS.profile and bench.FLAGS.suites == ["loop"]
            assert bench.FLAGS.tasks == bench.PAPERS_TASKS  # as given
        finally:
            bench.FLAGS["tasks"].present = 0


@pytest.mark.parametrize("name", bench.NAMED)
def test_a_suite_by_name_is_one_that_could_be_typed(name):
    bench.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(suite=name), flagsaver.flagsaver():
        bench.check_flags()


def test_a_peer_that_is_not_installed_is_told_before_anything_runs(monkeypatch):
    monkeypatch.setitem(bench.compare.NEEDS, "sbx", "no_such_module")
    bench.FLAGS.mark_as_parsed()
    with (
        flagsaver.flagsaver(compare=["sbx"]),
        pytest.raises(SystemExit, match="^--compare: sbx needs a Python with sbx"),
    ):
        bench.main(["bench"])


def test_more_devices_than_there_are_are_refused(monkeypatch):
    monkeypatch.setattr(bench.runtime, "prepare", lambda: None)
    cached = jax.config.jax_enable_compilation_cache
    bench.FLAGS.mark_as_parsed()
    try:
        with (
            flagsaver.flagsaver(devices=["1", "99"]),
            pytest.raises(SystemExit, match="^--devices: takes at most . here"),
        ):
            bench.main(["bench"])
    finally:
        jax.config.update("jax_enable_compilation_cache", cached)


def test_limits_of_the_solver_are_pairs():
    bench.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(solver=["100/50", "8/3"]):
        first, second = bench.solver_limits().items()
    assert first == ("100/50", {"iterations": 100, "ls_iterations": 50})
    assert second == ("8/3", {"iterations": 8, "ls_iterations": 3})
