"""The parity report: its comparisons notice errors, and its tables hold every task and physics."""

from functools import cache

import jax.numpy as jnp
import pytest
from absl.testing import flagsaver

from experiments import parity
from experiments.gymnasium_parity.gymnasium_reference import episode
from sqt_jax import envs


@cache
def swimmer():
    return envs.make("swimmer", "mujoco"), [episode("swimmer", 0, 1.0, steps=30)]


def test_whole_episodes_are_equal_and_a_fault_is_seen():
    env, episodes = swimmer()
    found = parity.compare_episodes(env, episodes)
    assert found.steps == 30 and found.terminations_agree
    assert found.obs < 1e-6 and found.reward < 1e-6

    def faulty(timestep, action):
        timestep = env.step(timestep, action)
        return timestep._replace(reward=timestep.reward + 0.5, terminated=jnp.array(True))

    found = parity.compare_episodes(env._replace(step=faulty), episodes)
    assert found.obs < 1e-6 and found.reward > 0.1 and not found.terminations_agree


def test_single_steps_are_near_and_a_fault_is_seen():
    env, _ = swimmer()
    found = parity.compare_steps("swimmer", env, 16)
    assert max(found[:6]) < 1e-5 and found.terminations_agree == 1

    def weaker(timestep, action):
        return env.step(timestep, 0.9 * action)

    found = parity.compare_steps("swimmer", env._replace(step=weaker), 16)
    assert found.qvel_median > 1e-3 and found.reward_median > 1e-6


def test_the_report_has_a_row_for_every_task_and_physics(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(parity.runtime, "prepare", lambda: None)
    monkeypatch.setattr(parity, "episode", lambda name, seed, scale: episode(name, seed, scale, steps=20))
    parity.FLAGS.mark_as_parsed()
    out = tmp_path / "new" / "parity.md"
    with flagsaver.flagsaver(
        tasks=["hopper", "walker-v5"],
        physics=["mujoco"],
        states=16,
        starts=16,
        episodes=2,
        seconds=0.0,
        repeats=1,
        out=str(out),
    ):
        monkeypatch.setattr(parity.sys, "argv", ["parity", "--states=16"])
        parity.main(["parity"])
    text = out.read_text()
    assert text in capsys.readouterr().out
    assert text.count("| Hopper-v4 |") == text.count("| Walker2d-v5 |") == 4
    assert "| Hopper-v4 | mujoco | " in text and "DIFFER" not in text
    assert "| Hopper-v4 | 16 | " in text and "| Walker2d-v5 | 2 | " in text
    speed = text.split("| Hopper-v4 | mujoco |")[1].split("\n")[0].split("|")[-2]
    assert float(speed.replace(",", "")) > 0
    assert "`python -m experiments.parity --states=16`" in text


@pytest.mark.parametrize(("flag", "value"), [("tasks", "hopper2"), ("physics", "bullet")])
def test_wrong_names_are_told_in_one_line(flag, value):
    parity.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(**{flag: [value]}), pytest.raises(SystemExit) as error:
        parity.main(["parity"])
    assert str(error.value).startswith(f"--{flag}: expects some of ") and "\n" not in str(error.value)


OTHERS = ["suites", "suite", "algos", "members", "devices", "capacities", "profile", "figures", "compare", "json"]


@pytest.mark.parametrize("name", [*OTHERS, "peer_python"])
def test_flags_that_the_benchmark_alone_has_a_use_for_are_refused(name):
    parity.FLAGS.mark_as_parsed()
    parity.FLAGS[name].present = 1
    try:
        with pytest.raises(
            SystemExit, match=f"^--{name}: has no effect here; expects of the benchmark's flags --tasks"
        ):
            parity.main(["parity"])
    finally:
        parity.FLAGS[name].present = 0
    for taken in parity.TAKEN:
        parity.FLAGS[taken].present += 1
    try:
        parity.refuse_others()
    finally:
        for taken in parity.TAKEN:
            parity.FLAGS[taken].present -= 1


def test_a_report_that_cannot_be_written_is_refused_before_anything_runs(tmp_path):
    parity.FLAGS.mark_as_parsed()
    (tmp_path / "file").write_text("")
    for out, told in {
        tmp_path: "expects a file, which this folder",
        tmp_path / "file" / "a.md": "expects a file in",
    }.items():
        with flagsaver.flagsaver(out=str(out)), pytest.raises(SystemExit, match=f"^--out={out}: {told}"):
            parity.main(["parity"])


def test_limits_of_mjxs_solver_are_rows_of_their_own():
    parity.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(solver=["8/3"]):
        found = parity.cases(["mjx", "mujoco"])
        assert parity.cases(["mujoco"]).keys() == {"mujoco"}
    assert found["mjx 8/3"] == ("mjx", {"iterations": 8, "ls_iterations": 3})
    assert found["mjx"] == ("mjx", {}) and list(found) == ["mjx", "mujoco", "mjx 8/3"]
