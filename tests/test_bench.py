"""The benchmark measures what it says: rates per second, rows of every suite, wrong values told in one line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from absl.testing import flagsaver

from experiments import bench
from experiments.benchmarks.kernels import Kind
from experiments.benchmarks.measure import Failure
from sqt_jax.envs import physics


def test_ratios_are_those_of_one_task_and_number_of_members():
    rates = {"MuJoCo alone": 100.0, "mujoco": 90.0, "mjx": 50.0, "mjx, the file's iterations": 20.0}
    rows = [bench.Row("physics", f"ant, {what}", 5, "env steps", rate, 0.0) for what, rate in rates.items()]
    loops = {"td3 on ant, mjx": 200.0, "td3 on ant, mujoco": 250.0, "td3 on walker, mujoco": 300.0}
    loops["td3 on ant, warp"] = 500.0
    rows += [bench.Row("loop", what, 5, "env steps", rate, 0.0) for what, rate in loops.items()]
    rows += [
        bench.Row("loop", f"{what}, 5 devices", 5, "env steps", 3 * rate, devices=5) for what, rate in loops.items()
    ]
    assert bench.ratios(rows) == [
        "ant, 5 members: mujoco / MuJoCo alone = 0.90",
        "ant, 5 members: mjx / mjx, the file's iterations = 2.50",
        "td3 on ant, 5 members: mujoco / mjx = 1.25",
        "td3 on ant, 5 members: warp / mjx = 2.50",
        "td3 on ant, 5 members, 5 devices: mujoco / mjx = 1.25",
        "td3 on ant, 5 members, 5 devices: warp / mjx = 2.50",
    ]


@pytest.fixture
def run(monkeypatch, tmp_path):
    """The program with these rows in place of measurements."""

    def main(rows, **given):
        monkeypatch.setattr(bench, "rows", rows)
        with flagsaver.flagsaver(json=str(tmp_path / "bench.json"), **given):
            bench.FLAGS.mark_as_parsed()
            bench.main(["bench"])

    monkeypatch.setattr(bench.runtime, "prepare", lambda: None)
    monkeypatch.setattr(bench.runtime, "set_cpu_device_count", lambda devices: None)
    cached = jax.config.jax_enable_compilation_cache
    yield main
    jax.config.update("jax_enable_compilation_cache", cached)


def test_the_table_and_the_file_hold_every_row(run, tmp_path, capsys):
    found = [
        bench.Row("env", task, members, "env steps", 1234.5, 6.78) for task in ("ant", "walker") for members in (1, 5)
    ]
    run(lambda suites, physics, environment, **timing: found)
    text = capsys.readouterr().out
    assert text.count("| env | ") == 4 and "| env | ant | 5 | 1,234 | env steps/s | 6.8 |  |  |" in text
    report = json.loads((tmp_path / "bench.json").read_text())
    assert len(report["rows"]) == 4 and report["machine"]["jax"] == jax.__version__
    assert report["failed"] == [] and report["machine"]["devices"] == len(jax.devices())


def test_what_fails_is_told_and_loses_nothing(run, tmp_path, capsys):
    def rows(suites, physics, environment, **timing):
        yield bench.Row("loop", "a", 5, "env steps", 10.0, kinds=())
        yield Failure("loop: b, 5 members", "MemoryError: [/none]")
        yield bench.Row("loop", "c", 5, "env steps", 10.0, kinds=(Kind("dot", 30.0, 1.0), Kind("add", 12.0, 1.0)))

    with pytest.raises(SystemExit, match="^1 failed: "):
        run(rows)
    text = capsys.readouterr().out
    assert "\nfailed: loop: b, 5 members: MemoryError: [/none]\n" in text
    assert "\n  the profile shows no operation\n" in text and "2000.00 ms under the profiler (500.00 ms a step" in text
    assert "| loop | a | 5 | 10 | env steps/s |  |  |  |  |" in text
    assert "| loop | c | 5 | 10 | env steps/s |  |  |  | 42 |" in text
    report = json.loads((tmp_path / "bench.json").read_text())
    assert [row["what"] for row in report["rows"]] == ["a", "c"]
    assert report["failed"] == [{"what": "loop: b, 5 members", "why": "MemoryError: [/none]"}]


def test_the_file_is_written_with_every_row_and_the_table_where_it_is_stopped(run, tmp_path, capsys):
    def rows(suites, physics, environment, **timing):
        yield bench.Row("loop", "a", 5, "env steps", 10.0)
        assert [row["what"] for row in json.loads((tmp_path / "bench.json").read_text())["rows"]] == ["a"]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(rows)
    assert "| loop | a | 5 | 10 |" in capsys.readouterr().out


def test_a_measurement_that_raises_is_a_failure_and_the_next_is_made(monkeypatch):
    def raises(*case, **timing):
        yield bench.Row("checkpoint", "a", 5, "checkpoints", 1.0)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(bench, "bench_checkpoint", raises)
    bench.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(members=["5"], algos=["td3", "sac"], tasks=["ant"]):
        rows = list(bench.rows(["checkpoint"], [], {}, seconds=0.0, repeats=1))
    assert [getattr(row, "why", "") for row in rows] == ["", "OSError: [Errno 28] No space left on device"] * 2
    assert rows[3].what == "checkpoint: sac, ant"


def test_the_peers_take_no_memory_in_advance(run, monkeypatch):
    seen = []
    own = {name: value for name, value in os.environ.items() if name != "XLA_PYTHON_CLIENT_PREALLOCATE"}
    monkeypatch.setattr(os, "environ", own)
    monkeypatch.setattr(bench.compare, "lacks", lambda peer, interpreter: False)
    run(lambda suites, physics, environment, **timing: seen.append(environment) or [], compare=["sbx"])
    assert seen[0]["XLA_PYTHON_CLIENT_PREALLOCATE"] == "false"


@pytest.mark.parametrize(("backend", "share"), [("cpu", "80%"), ("gpu", "40%")])
def test_accelerators_have_a_peak_each_and_a_cpus_devices_one(monkeypatch, backend, share):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    row = bench.Row("update", "a", 5, "member updates", 8.0, 1.0, operations=1e9, devices=2)
    assert bench.cells(row, peak=1e10)[6:] == ("1", share, "")
    assert bench.cells(row, peak=0.0)[6:] == ("1", "", "")  # stopped before it was measured


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
        ("devices", "most"),
        ("members", "all"),
    ],
)
def test_a_wrong_name_is_told_in_one_line_before_anything_runs(flag, value):
    bench.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(**{flag: [value]}), pytest.raises(SystemExit) as error:
        bench.main(["bench"])
    message = str(error.value)
    assert message.startswith(f"--{flag}: expects ") and value in message and "\n" not in message


@pytest.mark.parametrize("flag", ["tasks", "algos", "members", "devices", "capacities", "physics"])
def test_a_list_of_nothing_is_refused_but_of_the_suites(flag, monkeypatch):
    bench.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(suites=[]):
        bench.check_flags()
    with flagsaver.flagsaver(**{flag: []}), pytest.raises(SystemExit, match=f"^--{flag}: expects at least one$"):
        bench.main(["bench"])


def test_figures_that_cannot_be_written_are_told_before_and_after(tmp_path):
    (tmp_path / "file").write_text("")
    bench.FLAGS.mark_as_parsed()
    given = {"suites": ["growth"], "members": ["5"], "figures": str(tmp_path / "file" / "below")}
    with flagsaver.flagsaver(**given):
        with pytest.raises(SystemExit, match="^--figures=.*/file/below: expects a folder that can be written$"):
            bench.main(["bench"])
        row = bench.Row("growth", "a", 5, "member updates", 10.0, point=("members", "td3", 5))
        with pytest.raises(
            SystemExit, match="^--figures=.*/file/below: expects a folder that can be written: Not a dir"
        ):
            bench.show([row], 0.0)


def test_physics_that_cannot_run_here_are_left_out_or_refused(run, monkeypatch, capsys):
    monkeypatch.setitem(physics.LACKS, "warp", lambda: "a part")
    run(lambda suites, physics, environment, **timing: [])
    assert "\nwithout warp, which needs a part\n" in capsys.readouterr().out
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
            assert bench.FLAGS.profile and bench.FLAGS.suites == ["loop"] and bench.FLAGS.devices == ["1", "auto"]
            assert bench.FLAGS.tasks == list(bench.PAPERS_TASKS)  # as given
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
    monkeypatch.setattr(bench.runtime, "set_cpu_device_count", lambda devices: None)
    cached = jax.config.jax_enable_compilation_cache
    bench.FLAGS.mark_as_parsed()
    try:
        with (
            flagsaver.flagsaver(devices=["1", "99"]),
            pytest.raises(SystemExit, match=r"^--devices: expects at most \d+ here"),
        ):
            bench.main(["bench"])
    finally:
        jax.config.update("jax_enable_compilation_cache", cached)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (
            {"suites": ["update", "growth"], "members": ["1", "5"]},
            "--members: expects one number where growth is measured",
        ),
        ({"compare": ["sbx"], "algos": ["td7"]}, "--algos: expects some of td3, sac with --compare=sbx"),
        ({"json": "/no/such/folder/bench.json"}, "--json: expects a file in a folder that is there"),
        ({"json": "/"}, "--json: expects a file in a folder that is there"),
    ],
)
def test_what_would_give_no_rows_or_lose_them_is_refused(given, told):
    bench.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(**given), pytest.raises(SystemExit, match=f"^{told}"):
        bench.main(["bench"])


def test_automatic_devices_are_left_to_the_number_of_members():
    bench.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(devices=["1", "auto"]):
        assert bench.devices_here() == [1, None]


def test_a_processor_is_as_many_devices_as_the_largest_sweep_takes():
    bench.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(members=["1", "7"], devices=["1", "3"]):
        assert bench.most_devices() == 3
        with flagsaver.flagsaver(devices=["1", "auto"]):
            assert bench.most_devices() == 7
        with flagsaver.flagsaver(compare=["sbx"]):
            assert bench.most_devices() == 7
        with flagsaver.flagsaver(suites=["growth"]):
            assert bench.most_devices() == 50


@pytest.mark.slow
def test_what_a_gpu_is_measured_by_runs_here(tmp_path):
    """The whole program, on one small case."""
    command = [
        sys.executable,
        "-m",
        "experiments.bench",
        "--suite=gpu",
        "--tasks=cheetah",
        "--algos=td3",
        "--members=1",
    ]
    command += ["--physics=mujoco", "--seconds=0", "--repeats=1", f"--json={tmp_path / 'bench.json'}"]
    done = subprocess.run(command, cwd=Path(__file__).parent.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "bench.json").read_text())
    (row,) = report["rows"]
    assert report["failed"] == [] and row["rate"] > 0 and row["kinds"]
    assert " operations a step, " in done.stdout and "| loop | td3 on cheetah, mujoco | 1 |" in done.stdout


def test_limits_of_the_solver_are_pairs():
    bench.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(solver=["100/50", "8/3"]):
        first, second = bench.solver_limits().items()
    assert first == ("100/50", {"iterations": 100, "ls_iterations": 50})
    assert second == ("8/3", {"iterations": 8, "ls_iterations": 3})
