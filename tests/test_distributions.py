"""Starts and episodes are Gymnasium's in distribution, and differences are detected."""

import jax
import pytest

from experiments.gymnasium_parity import distributions
from sqt_jax import envs
from sqt_jax.envs import TASKS, gym_tasks


@pytest.mark.parametrize("name", TASKS)
def test_starts_have_gymnasiums_distribution(name):
    found = distributions.compare_starts(name, 500)
    assert found.p_value > 1e-3
    assert found.mean < 5 / 500**0.5 and found.std < 0.2 and found.range < 0.1


@pytest.mark.parametrize("name", ["ant", "walker"])  # normal velocities and uniform ones
@pytest.mark.parametrize("fault", ["shifted", "wider", "of the other kind"])
def test_other_starts_are_detected(name, fault, monkeypatch):
    def drawn(task, qpos0, num_velocities, key, draw=gym_tasks.draw_start):
        if fault == "of the other kind":
            task = task._replace(normal_velocity=not task.normal_velocity)
        qpos, qvel = draw(task, qpos0, num_velocities, key)
        return qpos, {"shifted": qvel + task.noise / 2, "wider": 1.5 * qvel}.get(fault, qvel)

    monkeypatch.setattr(gym_tasks, "draw_start", drawn)
    assert distributions.compare_starts(name, 500).p_value < 1e-3


def fast_or_slow(name):
    return name if name in ("walker", "hopper") else pytest.param(name, marks=pytest.mark.slow)


@pytest.mark.parametrize("name", [fast_or_slow(name) for name in TASKS])
def test_episodes_have_gymnasiums_distribution(name):
    found = distributions.compare_play(name, envs.make(name, "mujoco"), 60)
    assert found.length_p_value > 1e-3 and found.return_p_value > 1e-3
    assert (found.their_lengths.std() > 0) == (TASKS[name].healthy is not None)


def test_other_episodes_are_detected():
    env = envs.make("hopper", "mujoco")
    found = distributions.compare_play("hopper", env._replace(step=lambda t, action: env.step(t, -action)), 60)
    assert found.length_p_value < 1e-3 and found.return_p_value < 1e-3


def test_the_tables_have_a_row_for_every_task():
    starts = distributions.StartComparison(10, 0.1, 0.02, 0.0, 1.0)
    lengths = jax.numpy.array([10.0, 20.0])
    played = distributions.EpisodeComparison(2, lengths, lengths + 1, 0.5, 0.25)
    assert distributions.start_table(dict.fromkeys(TASKS, starts))[2:] == [
        f"| {task.gymnasium_id} | 10 | 0.100 | 0.020 | 0.000 | 1.00 |" for task in TASKS.values()
    ]
    assert distributions.play_table({"ant": played})[2] == "| Ant-v4 | 2 | 15.0 ± 7.1 | 16.0 ± 7.1 | 0.50 | 0.25 |"
