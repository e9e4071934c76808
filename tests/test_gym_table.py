"""The table of tasks: when they terminate, how v5 differs, and the names of versions."""

import jax.numpy as jnp
import pytest

from sqt_jax.envs.gym_table import ALIASES, TASKS, versioned


@pytest.mark.parametrize(
    ("name", "qpos", "healthy"),
    [
        ("walker", [9, 1.25, 0], True),
        ("walker", [9, 0.79, 0], False),
        ("walker", [9, 2.01, 0], False),
        ("walker", [9, 1.25, 1.01], False),
        ("walker", [9, 1.25, -1.01], False),
        ("ant", [9, 9, 0.21], True),
        ("ant", [9, 9, 1.0], True),  # its limits are included
        ("ant", [9, 9, 0.19], False),
        ("ant", [9, 9, 1.01], False),
        ("humanoid", [9, 9, 1.4], True),
        ("humanoid", [9, 9, 1.0], False),  # its limits are not
        ("humanoid", [9, 9, 2.0], False),
        ("hopper", [9, 0.71, 0.19], True),
        ("hopper", [9, 0.69, 0], False),
        ("hopper", [9, 1.25, 0.21], False),
        ("hopper", [9, 1.25, -0.21], False),
        ("hopper", [9, 1.25, 0, 101], False),
    ],
)
def test_healthy_ranges(name, qpos, healthy):
    for task in (TASKS[name], TASKS[f"{name}-v5"]):
        assert bool(task.healthy(jnp.asarray(qpos, jnp.float32), jnp.zeros(2))) is healthy


def test_the_hopper_falls_by_a_velocity_too():
    qpos = jnp.array([9, 1.25, 0.0])
    velocities = {99.0: True, 100.0: False, -101.0: False}
    assert {v: bool(TASKS["hopper"].healthy(qpos, jnp.array([0, v]))) for v in velocities} == velocities


def test_three_tasks_never_terminate():
    never = {name.removesuffix("-v5") for name, task in TASKS.items() if task.healthy is None}
    assert never == {"cheetah", "swimmer", "humanoid_standup"}


@pytest.mark.parametrize(
    ("name", "row"),
    [("Ant-v4", "ant"), ("ant", "ant"), ("HalfCheetah-v5", "cheetah-v5"), ("walker2d", "walker"), ("ant-v3", "ant-v3")],
)
def test_v4_has_no_suffix_and_other_versions_keep_theirs(name, row):
    assert versioned(name) == row


def test_every_task_has_a_v5_and_every_alias_a_task():
    names = {name for name in TASKS if not name.endswith("-v5")}
    assert {f"{name}-v5" for name in names} | names == set(TASKS) and set(ALIASES.values()) <= names
    for name in names:
        assert TASKS[name].gymnasium_id.endswith("-v4")
        assert TASKS[f"{name}-v5"].gymnasium_id == TASKS[name].gymnasium_id.replace("-v4", "-v5")
