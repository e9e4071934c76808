"""Runs that are killed end like a run without a break."""

import subprocess
import sys
import time

import pytest

from experiments.endurance.kills import kill_and_resume, run_kill_test, train_reference
from experiments.endurance.run_results import differences, read_results
from experiments.endurance.training_process import TASKS
from experiments.running.run_policies import read_evaluations


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """A training without a break (in fact two: the same command twice is bit-identical)."""
    return train_reference("tiny", "td3_sqt", tmp_path_factory.mktemp("reference") / "run")


@pytest.mark.parametrize("number", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_killed_run_ends_like_a_run_without_a_break(tmp_path, reference, number):
    line = kill_and_resume("tiny", "td3_sqt", tmp_path / "run", reference, number)
    assert "killed a" in line and line.endswith("resumed, identical")


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("algo", ["td3_sqt", "sac_sqt_tuple", "td7_sqt"])
def test_more_kills(tmp_path, task, algo):
    reference = train_reference(task, algo, tmp_path / "reference")
    for number in range(100, 108):
        kill_and_resume(task, algo, tmp_path / f"kill_{number}", reference, number)


@pytest.mark.slow
def test_kills_are_spread_over_the_cases_and_failures_counted(tmp_path):
    lines = []
    assert run_kill_test([("tiny", "td3_sqt"), ("tiny", "sac")], 3, 2, tmp_path, lines.append) == 0
    assert sum("resumed, identical" in line for line in lines) == 3
    assert sum("sac: killed" in line for line in lines) == 1
    assert lines[-1] == "3 kills, 3 resumed to the identical end, 0 failed"


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["td3", "td7"])
def test_a_killed_run_can_be_played_and_ends_with_the_best_policies_of_a_run_without_a_break(tmp_path, algo):
    command = f"--algo={algo} --env=hopper --physics=mujoco --seeds=0,1 --steps=2000 --warmup_steps=300 --hidden=16,16"
    command += " --eval_every=200 --eval_episodes=2 --batch_size=16 --checkpoint_every=500 --name=run --quiet"

    def words(name):
        return [sys.executable, "-m", "experiments.run", *command.split(), f"--out={tmp_path / name}"]

    def done(*arguments):
        process = subprocess.run(arguments, capture_output=True, text=True, timeout=600)
        assert (process.returncode, process.stderr) == (0, "")
        return process.stdout

    done(*words("unbroken"))
    unbroken, path = (tmp_path / name / "hopper" / algo / "run" for name in ("unbroken", "killed"))
    killed = subprocess.Popen(words("killed"))
    end = time.monotonic() + 600
    while not list(path.glob("checkpoint/step_??????????")) and time.monotonic() < end:
        time.sleep(0.01)
    killed.kill()
    assert killed.wait() == -9 and not (path / "policy").exists()
    for which, says in (("last", "the last one"), ("best", "the best evaluated one, of step")):
        printed = done(sys.executable, "-m", "experiments.play", str(path), f"--policy={which}", "--steps=5")
        assert f"policy: {says}" in printed and "from the checkpoint at step" in printed and "episode 0: " in printed
    done(*words("killed"), "--resume")
    assert differences(read_results(unbroken), read_results(path)) == []
    best = read_evaluations(path / "policy_best")
    assert any(entry.env_steps > 300 for entry in best.values())  # not the initial ones: there is something to compare
    assert {name.split("/")[0] for name in read_results(path) if "/member_1/" in name} == {"policy", "policy_best"}
