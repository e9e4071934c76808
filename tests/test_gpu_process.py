"""The measurements of a part's process, at tiny sizes on this machine."""

import pytest

from experiments.benchmarks import gpu_process
from experiments.benchmarks.gpu_trace import Work
from experiments.benchmarks.measure_gpu import Part, bench_gpu
from experiments.benchmarks.measurements import ERROR, GRAPHS, HOST_SYNCS, KERNELS, Failure, Measurement, Prepared
from experiments.gymnasium_parity.trajectories import StepErrors


def test_a_loop_is_told_from_the_default_by_its_label(monkeypatch):
    rows = [Measurement("loop", "td3 on ant, warp", 5, "env steps"), Failure("loop: td3 on ant", "why")]
    monkeypatch.setattr(gpu_process, "bench_loops", lambda *case, **timing: rows)
    found = gpu_process.loop("td3", "ant", "warp", 5, seconds=0.0, repeats=1, label=", a label")
    assert [row.what for row in found] == ["td3 on ant, warp, a label", "loop: td3 on ant, a label"]


def test_parity_gives_the_median_error_of_velocities(monkeypatch):
    errors = StepErrors(1e-6, 2e-5, 3e-6, 0.0, 4e-7, 0.0, 1.0)
    monkeypatch.setattr(gpu_process.envs, "make", lambda task, physics: (task, physics))
    monkeypatch.setattr(gpu_process, "compare_steps", lambda task, env, count: errors)
    (row,) = gpu_process.parity("ant", "warp")
    assert row.figure == ("1e-06", ERROR)
    assert row.what == (
        "ant, warp, a control step against MuJoCo "
        "(95 %: 2.0e-05, observation 3.0e-06, reward 4.0e-07, terminations equal in 100 %)"
    )


def test_a_profile_gives_counts_of_one_step(monkeypatch):
    monkeypatch.setattr(gpu_process, "loop_steps", lambda *case: Prepared(lambda steps: None))
    monkeypatch.setattr(gpu_process.kernels, "record", lambda run, steps: [])
    work = Work(kernels=800, graphs=8, copies_to_host=12, seconds=0.008, longest={"dot": 0.75})
    monkeypatch.setattr(gpu_process.gpu_trace, "count", lambda events: work)
    rows = list(gpu_process.profile("td3", "ant", "warp", 25))
    assert [(row.rate, row.unit) for row in rows] == [(200.0, KERNELS), (2.0, GRAPHS), (3.0, HOST_SYNCS)]
    assert rows[0].what == "td3 on ant, warp (busy 2.00 ms a step: dot 75%)"


@pytest.mark.slow
def test_loop_parity_and_profile_run_here():
    """In processes of their own, as in the suite."""
    case = {"algo": "td3_sqt", "task": "cheetah", "physics": "mujoco", "members": 1}
    parts = [
        Part("loop", {**case, "seconds": 0.0, "repeats": 1}, 300),
        Part("parity", {"task": "cheetah", "physics": "mjx"}, 300),
        Part("profile", case, 300),
    ]
    rows = list(bench_gpu(parts))
    found = [row for row in rows if row.suite != "seconds"]
    assert [row.suite for row in found] == ["loop", "parity", *["profile"] * 3] and len(rows) == len(found) + 3
    assert found[0].rate > 0 and 0 < found[1].rate < 2e-5 and found[2].rate > 10
