"""Every algorithm and every task start with default settings, through the command line.

An agent knows a task by its sizes only, so algorithms and tasks are not combined.
"""

import csv

import pytest

from experiments.run import main
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.envs import PHYSICS, TASKS, lacks

# A task's version 5 has the physics of its version 4: it is compiled on the fastest physics only.
CASES = [
    pytest.param(task, name, marks=pytest.mark.skipif(bool(lacks(name)), reason=lacks(name)))
    for task in TASKS
    for name in PHYSICS
    if name == "mujoco" or not task.endswith("-v5")
]
TINY = ["--steps=300", "--warmup_steps=290", "--eval_every=300", "--eval_episodes=1", "--name=tiny", "--quiet"]


def starts(algo, env, out, *more):
    assert main(["run", f"--algo={algo}", f"--env={env}", f"--out={out}", *TINY, *more]) == 0
    path = out / env / algo / "tiny"
    with (path / "evaluations.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["env_steps"] for row in rows] == ["0"] * 5 + ["300"] * 5
    assert all(row["return_mean"] for row in rows) and (path / "policy" / "member_4.npz").exists()


@pytest.mark.slow
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_algorithm_starts(algo, tmp_path):
    starts(algo, "ant", tmp_path, "--physics=mujoco")


@pytest.mark.slow
@pytest.mark.parametrize(("env", "physics"), CASES)
def test_every_task_starts_on_all_physics(env, physics, tmp_path):
    starts("td3_sqt", env, tmp_path, f"--physics={physics}", f"--eval_physics={physics}")


@pytest.mark.slow
@pytest.mark.parametrize("algo", [algo for algo in ALGORITHMS if algo.startswith(("td3", "sac", "td7"))])
def test_the_released_preset_starts(algo, tmp_path):
    starts(algo, "cheetah", tmp_path, "--preset=released", "--physics=mujoco")
