"""The benchmark's command: everything measured is printed and saved, whatever fails or interrupts it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from absl.testing import flagsaver

from experiments import bench
from experiments.benchmarks import session
from experiments.benchmarks.kernels import Kind
from experiments.benchmarks.measurements import Failure, Measurement
from sqt_jax.envs import physics


@pytest.fixture
def run(monkeypatch, tmp_path):
    """The command with a function in place of `suites.measure_all`."""

    def main(measure_all, **given):
        monkeypatch.setattr(session.suites, "measure_all", measure_all)
        with flagsaver.flagsaver(json=str(tmp_path / "bench.json"), **given):
            bench.FLAGS.mark_as_parsed()
            bench.main(["bench"])

    monkeypatch.setattr(bench.jax_settings, "prepare", lambda: None)
    monkeypatch.setattr(bench.jax_settings, "start_jax", lambda devices: None)
    cached = jax.config.jax_enable_compilation_cache
    yield main
    jax.config.update("jax_enable_compilation_cache", cached)


def test_the_table_and_the_file_hold_every_measurement(run, tmp_path, capsys):
    found = [
        Measurement("env", task, members, "env steps", 1234.5, 6.78) for task in ("ant", "walker") for members in (1, 5)
    ]
    run(lambda request, environment, **timing: found)
    text = capsys.readouterr().out
    assert text.count("| env | ") == 4 and "| env | ant | 5 | 1,234 | env steps/s | 6.8 |  |  |" in text
    report = json.loads((tmp_path / "bench.json").read_text())
    assert len(report["rows"]) == 4 and report["machine"]["jax"] == jax.__version__
    assert report["failed"] == [] and report["machine"]["devices"] == len(jax.devices())


def test_a_failure_is_reported_and_loses_nothing(run, tmp_path, capsys):
    def measure_all(request, environment, **timing):
        yield Measurement("loop", "a", 5, "env steps", 10.0, kinds=())
        yield Failure("loop: b, 5 members", "MemoryError: [/none]")
        yield Measurement("loop", "c", 5, "env steps", 10.0, kinds=(Kind("dot", 30.0, 1.0), Kind("add", 12.0, 1.0)))

    with pytest.raises(SystemExit, match="^1 failed: "):
        run(measure_all)
    text = capsys.readouterr().out
    assert "\nfailed: loop: b, 5 members: MemoryError: [/none]\n" in text
    assert "\n  the profile has no operations\n" in text and "2000.00 ms under the profiler (500.00 ms per step" in text
    assert "| loop | a | 5 | 10 | env steps/s |  |  |  |  |" in text
    assert "| loop | c | 5 | 10 | env steps/s |  |  |  | 42 |" in text
    report = json.loads((tmp_path / "bench.json").read_text())
    assert [row["what"] for row in report["rows"]] == ["a", "c"]
    assert report["failed"] == [{"what": "loop: b, 5 members", "why": "MemoryError: [/none]"}]


def test_the_file_is_written_with_every_measurement_and_the_table_when_interrupted(run, tmp_path, capsys):
    def measure_all(request, environment, **timing):
        yield Measurement("loop", "a", 5, "env steps", 10.0)
        assert [row["what"] for row in json.loads((tmp_path / "bench.json").read_text())["rows"]] == ["a"]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(measure_all)
    assert "| loop | a | 5 | 10 |" in capsys.readouterr().out


@pytest.mark.parametrize(("asked", "peak"), [(True, 5.0), (False, 0.0)])
def test_the_peak_is_measured_with_updates_unless_switched_off(run, tmp_path, monkeypatch, asked, peak):
    monkeypatch.setattr(session.operations, "peak", lambda **timing: 5.0)
    run(lambda *given, **timing: [Measurement("update", "a", 5, "member updates", 1.0, operations=1.0)], peak=asked)
    assert json.loads((tmp_path / "bench.json").read_text())["peak"] == peak


def test_peers_do_not_allocate_memory_in_advance(run, monkeypatch):
    seen = []
    own = {name: value for name, value in os.environ.items() if name != "XLA_PYTHON_CLIENT_PREALLOCATE"}
    monkeypatch.setattr(os, "environ", own)
    monkeypatch.setattr(bench.compare, "lacks", lambda peer, interpreter: False)
    run(lambda request, environment, **timing: seen.append(environment) or [], compare=["sbx"])
    assert seen[0]["XLA_PYTHON_CLIENT_PREALLOCATE"] == "false"


def test_a_file_that_cannot_be_written_is_an_error_line_after_the_table(run, tmp_path, capsys):
    def measure_all(request, environment, **timing):
        (tmp_path / "bench.json").mkdir()
        yield Measurement("loop", "a", 5, "env steps", 10.0)

    with pytest.raises(SystemExit, match="^--json=.*/bench.json: expects a file that can be written: "):
        run(measure_all)
    assert "| loop | a | 5 | 10 |" in capsys.readouterr().out


def test_physics_that_cannot_run_here_is_reported(run, monkeypatch, capsys):
    monkeypatch.setitem(physics.LACKS, "warp", lambda: "a part")
    run(lambda request, environment, **timing: [])
    assert "\nwithout warp, which needs a part\n" in capsys.readouterr().out


def test_a_flag_error_exits_with_its_line_before_anything_runs():
    bench.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(tasks=["hopper2"]), pytest.raises(SystemExit, match="^--tasks: expects some of "):
        bench.main(["bench"])


def test_help_lists_the_flags(commands):
    done = commands.run("bench", "--help")
    assert "Suites:\n" in done.stdout and "  --suites: What to measure" in done.stdout


@pytest.mark.slow
def test_the_gpu_suite_runs_here(tmp_path):
    """The complete program, on one small case."""
    command = [
        sys.executable,
        "-m",
        "experiments.bench",
        "--suite=gpu",
        "--tasks=cheetah",
        "--parts=loops",
        "--members=1",
        "--patience=10",
    ]
    command += ["--physics=mujoco", "--seconds=0", "--repeats=1", f"--json={tmp_path / 'bench.json'}"]
    done = subprocess.run(command, cwd=Path(__file__).parent.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "bench.json").read_text())
    row, seconds = report["rows"]
    assert report["failed"] == [] and row["rate"] > 0 and seconds["suite"] == "seconds"
    assert "| loop | td3_sqt on cheetah, mujoco | 1 |" in done.stdout
