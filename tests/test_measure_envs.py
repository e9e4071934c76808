"""Environments: MuJoCo without JAX steps them too."""

import pytest

from experiments.benchmarks import measure_envs


@pytest.mark.parametrize("task", ["swimmer", "humanoid"])
def test_mujoco_without_jax_steps_with_and_without_contact_forces(task, monkeypatch):
    made = []
    original = measure_envs.mujoco.mj_rnePostConstraint
    monkeypatch.setattr(measure_envs.mujoco, "mj_rnePostConstraint", lambda *args: made.append(original(*args)))
    measure_envs.mujoco_steps(task, 3)(2)
    assert len(made) == (6 if task == "humanoid" else 0)
