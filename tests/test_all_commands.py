"""Every algorithm starts on every task with its default settings, through the command line."""

import csv

import pytest

from experiments.run import main
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.envs import TASKS


@pytest.mark.slow
@pytest.mark.parametrize("env", TASKS)
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_algorithm_starts_on_every_task(algo, env, tmp_path):
    argv = ["run", f"--algo={algo}", f"--env={env}", "--steps=300", "--warmup_steps=290", "--eval_every=300"]
    assert main([*argv, "--eval_episodes=1", f"--out={tmp_path}", "--name=tiny", "--quiet"]) == 0
    path = tmp_path / env / algo / "tiny"
    with (path / "evaluations.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["env_steps"] for row in rows] == ["0"] * 5 + ["300"] * 5
    assert all(row["return_mean"] for row in rows) and (path / "policy" / "member_4.npz").exists()
