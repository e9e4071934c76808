"""The parts of the locomotion tasks by hand; complete steps are compared in test_gymnasium_parity."""

import itertools
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.gymnasium_parity.gymnasium_reference import gymnasium_environment
from sqt_jax import envs
from sqt_jax.envs import TASKS, gym_tasks
from sqt_jax.envs.autoreset import MIN_STEPS_TO_FALL
from sqt_jax.envs.physics import PHYSICS, Physics, PhysicsState


def state(qpos=(0.0,), qvel=(0.0,), displacement=0.0, quantities=None):
    def array(x):
        return jnp.asarray(x, jnp.float32)

    return PhysicsState(array(qpos), array(qvel), array(displacement), quantities or {}, ())


@pytest.mark.parametrize(
    ("name", "control", "expected"),
    [
        # displacement 0.1 m in 0.05 s: 2 m/s
        ("cheetah", [0.5, -0.5, 1, 0, 0, 0], 2 - 0.1 * 1.5),
        ("walker", [0.5, -0.5, 1, 0, 0, 0], 2 + 1 - 0.001 * 1.5),
        ("ant", [0.5, -0.5, 1, 0, 0, 0, 0, 0], 2 + 1 - 0.5 * 1.5),
        ("humanoid", [0.4] * 10 + [0] * 7, 1.25 * 2 + 5 - 0.1 * 1.6),
        ("hopper", [0.5, -0.5, 1], 2 + 1 - 0.001 * 1.5),
        ("swimmer", [0.5, -1], 2 - 1e-4 * 1.25),
        ("humanoid_standup", [0.4] * 10 + [0] * 7, 0.5 / 0.003 + 1 - 0.1 * 1.6),
    ],
)
def test_reward_by_hand(name, control, expected):
    there = state([0, 0, 0.5], displacement=0.1, quantities={"cfrc_ext": jnp.zeros(12)})
    control = jnp.asarray(control, jnp.float32)
    for task in (TASKS[name], TASKS[f"{name}-v5"]):
        for ended in (False, True):
            reward = gym_tasks.reward(task, there, control, 0.05, jnp.array(ended))
            # v5 does not reward the step that terminates for being alive.
            lost = task.alive if ended and task.gymnasium_id.endswith("-v5") and task.healthy else 0
            np.testing.assert_allclose(reward, expected - lost, rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "forces", "cost"),
    [
        ("ant", [3.0, -0.5], 0),
        ("ant-v5", [3.0, -0.5], 5e-4 * (1 + 0.25)),  # each force clipped to 1
        ("humanoid", [3000.0, 0], 0),
        ("humanoid-v5", [3000.0, 0], 5e-7 * 9e6),
        ("humanoid-v5", [9000.0, 0], 10),  # the sum is clipped to 10
        ("humanoid_standup", [3000.0, 0], 5e-7 * 9e6),
        ("humanoid_standup-v5", [-9000.0, 0], 10),
    ],
)
def test_cost_of_contacts(name, forces, cost):
    def reward(forces):
        there = state([0, 0, 0.0], quantities={"cfrc_ext": jnp.asarray(forces, jnp.float32)})
        return gym_tasks.reward(TASKS[name], there, jnp.zeros(2), 0.05, jnp.zeros((), bool))

    np.testing.assert_allclose(reward([0.0, 0.0]) - reward(forces), cost, rtol=1e-4, atol=1e-6)


def test_observation_leaves_out_the_horizontal_position():
    np.testing.assert_array_equal(gym_tasks.observe(TASKS["cheetah"], state([1, 2, 3], [4, 5])), [2, 3, 4, 5])
    np.testing.assert_array_equal(gym_tasks.observe(TASKS["ant"], state([1, 2, 3], [4, 50])), [3, 4, 50])


def test_walker_observes_clipped_velocities():
    np.testing.assert_array_equal(gym_tasks.observe(TASKS["walker"], state([1, 20], [-30, 30])), [20, -10, 10])


def test_humanoid_observes_its_quantities_in_order():
    fields = {"cfrc_ext": jnp.full(1, 4.0), "qfrc_actuator": jnp.full(1, 3.0), "cvel": jnp.full(1, 2.0)}
    fields["cinert"] = jnp.full(1, 1.0)
    obs = gym_tasks.observe(TASKS["humanoid"], state([7, 7, 0], [0], quantities=fields))
    np.testing.assert_array_equal(obs, [0, 0, 1, 2, 3, 4])


def test_v5_leaves_out_the_worlds_entries_and_the_roots_forces_and_clips():
    width = {"cinert": 20, "cvel": 12, "qfrc_actuator": 8, "cfrc_ext": 12}
    fields = {name: jnp.arange(size) - 8.0 for name, size in width.items()}
    obs = gym_tasks.observe(TASKS["humanoid-v5"], state([7, 7, 0.5], [0.25], quantities=fields))
    parts = [np.arange(2.0, 12), np.arange(-2.0, 4), np.arange(-2.0, 0), np.arange(-2.0, 4)]
    np.testing.assert_array_equal(obs, np.concatenate([[0.5, 0.25], *parts]))
    obs = gym_tasks.observe(TASKS["ant-v5"], state([7, 7, 0.5], [0.25], quantities=fields))
    np.testing.assert_array_equal(obs, [0.5, 0.25, -1, -1, 0, 1, 1, 1])


@pytest.mark.parametrize("name", TASKS)
def test_starts_have_gymnasiums_distribution(name):
    task, model = TASKS[name], gym_tasks.load_model(TASKS[name])
    keys = jax.random.split(jax.random.key(0), 4000)
    qpos, qvel = jax.vmap(lambda key: gym_tasks.draw_start(task, model.qpos0, model.nv, key))(keys)
    offset = (np.asarray(qpos, np.float64) - model.qpos0) / task.noise
    velocity = np.asarray(qvel, np.float64) / task.noise
    assert np.abs(offset).max() <= 1 + 2e-4  # rounding at a rest pose of up to 1.4
    assert np.abs(offset).max() > 0.99
    np.testing.assert_allclose(offset.mean(axis=0), 0, atol=0.05)
    np.testing.assert_allclose(offset.std(axis=0), 1 / np.sqrt(3), atol=0.03)
    np.testing.assert_allclose(velocity.mean(axis=0), 0, atol=0.08)
    np.testing.assert_allclose(velocity.std(axis=0), 1 if task.normal_velocity else 1 / np.sqrt(3), atol=0.05)
    assert (np.abs(velocity).max() > 2) == task.normal_velocity
    assert np.abs(np.corrcoef(offset[:, 0], velocity[:, 0])[0, 1]) < 0.06  # positions and velocities: own draws


@pytest.mark.parametrize("name", TASKS)
def test_actions_are_scaled_to_the_actuators_range(name, recording_physics):
    limit = 0.4 if name.startswith("humanoid") else 1.0
    env = envs.make(name, physics="recording")
    action = jnp.linspace(-1, 1, env.action_size)
    timestep = env.step(env.reset(jax.random.key(0)), action)
    np.testing.assert_allclose(timestep.state.task.internal, limit * action, rtol=1e-6)
    expected = TASKS[name].alive - TASKS[name].ctrl_cost * np.sum((limit * np.asarray(action)) ** 2)
    expected += TASKS[name].height * float(timestep.state.task.qpos[2])
    np.testing.assert_allclose(timestep.reward, expected, rtol=1e-5)  # the cost is that of the scaled action
    excess = env.step(env.reset(jax.random.key(0)), 5 * jnp.ones(env.action_size))
    np.testing.assert_allclose(excess.state.task.internal, limit, rtol=1e-6)


def test_a_tasks_options_reach_its_physics_and_the_callers_override_them(monkeypatch):
    seen = []

    def make_physics(name, setup, **options):
        seen.append((name, options))
        return Physics(lambda qpos, qvel: state(qpos, qvel), None)

    monkeypatch.setattr(gym_tasks, "make_physics", make_physics)
    for physics, options in [("mjx", {}), ("mjx", {"iterations": 20}), ("mujoco", {})]:
        envs.make("ant", physics, **options)
    assert seen == [
        ("mjx", {"iterations": 7, "ls_iterations": 3}),
        ("mjx", {"iterations": 20, "ls_iterations": 3}),
        ("mujoco", {}),
    ]


@pytest.fixture
def recording_physics(monkeypatch):
    """Physics in which nothing moves and the state keeps the last control."""

    def make(setup):
        shapes = {"cinert": setup.model.nbody * 10, "cvel": setup.model.nbody * 6, "qfrc_actuator": setup.model.nv}
        shapes["cfrc_ext"] = setup.model.nbody * 6
        fields = {field: jnp.zeros(shapes[field]) for field in setup.quantities}

        def place(qpos, qvel):
            return PhysicsState(qpos, qvel, jnp.zeros(()), fields, jnp.zeros(setup.model.nu))

        return Physics(place, lambda state, control: state._replace(internal=control))

    module = types.ModuleType("recording_physics")
    module.make = make
    monkeypatch.setitem(sys.modules, "recording_physics", module)
    monkeypatch.setitem(PHYSICS, "recording", "recording_physics")


def test_models_load_without_a_log_file(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    gym_tasks.load_model(TASKS["cheetah"])
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["hopper", "walker", "ant", "humanoid"])
def test_no_constant_action_at_its_limits_makes_a_robot_fall_sooner_than_the_replay_has_room_for(name):
    """All corners, or sixty-four at random where there are more; with mean lengths over three starts."""
    env = gymnasium_environment(name)
    low, high = env.model.actuator_ctrlrange.T
    generator, size = np.random.default_rng(0), env.model.nu
    every = itertools.product([0, 1], repeat=size) if size <= 6 else generator.integers(0, 2, (64, size))
    lengths = {}
    for corner in every:
        action, steps = np.where(corner, high, low), 0
        for seed in range(3):
            env.reset(seed=seed)
            steps += next((step for step in range(1, 31) if env.step(action)[2]), 30)
        lengths[tuple(corner)] = steps / 3
    shortest = min(lengths.values())
    assert shortest >= MIN_STEPS_TO_FALL
    assert name not in ("hopper", "walker") or shortest < 7  # the bound is tight


@pytest.mark.parametrize("name", ["cheetah", "walker", "ant", "hopper", "swimmer"])
def test_speed_is_gymnasiums_x_velocity(name):
    theirs, ours = gymnasium_environment(name), envs.make(name, "mujoco")
    theirs.reset(seed=0)
    timestep = jax.jit(ours.set_physics)(theirs.data.qpos, theirs.data.qvel)
    assert ours.speed(timestep) == 0
    step, generator = jax.jit(ours.step), np.random.default_rng(0)
    low, high = theirs.model.actuator_ctrlrange.T
    for _ in range(3):
        action = generator.uniform(-1, 1, theirs.model.nu)
        x_velocity = theirs.step((low + high) / 2 + action * (high - low) / 2)[4]["x_velocity"]
        timestep = step(timestep, jnp.float32(action))
        assert not timestep.terminated and abs(x_velocity) > 1e-3
        np.testing.assert_allclose(ours.speed(timestep), x_velocity, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("name", ["humanoid_standup", "humanoid_standup-v5"])
def test_standing_up_has_no_speed(name):
    assert envs.make(name, "mujoco").speed is None
