"""MuJoCo C inside compiled programs; complete episodes are compared with Gymnasium in test_gymnasium_parity."""

import concurrent.futures

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from gym_reference import recorded

from sqt_jax import envs
from sqt_jax.envs import gym_tasks
from sqt_jax.envs.gym_table import TASKS
from sqt_jax.envs.physics import Setup, mujoco_c, threads


def setup_of(name):
    task = TASKS[name]
    return Setup(gym_tasks.load_model(task), task.frame_skip, task.quantities, task.tracked)


def robots(physics, model, count, seed=0):
    """States of `count` robots near the rest pose, and controls."""
    generator = np.random.default_rng(seed)
    qpos = model.qpos0 + generator.uniform(-0.1, 0.1, (count, model.nq))
    qvel = generator.normal(size=(count, model.nv))
    control = generator.uniform(-0.4, 0.4, (count, model.nu))
    return jax.vmap(physics.place)(*map(jnp.float32, (qpos, qvel))), jnp.float32(control)


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@pytest.fixture(scope="module")
def ant():
    setup = setup_of("ant")
    physics = mujoco_c.make(setup)
    return physics, setup.model, jax.jit(jax.vmap(physics.advance))


def test_a_step_is_a_function_of_the_state_it_is_given(ant):
    physics, model, advance = ant
    state, control = robots(physics, model, 7)
    once = advance(state, control)
    advance(once, -control)  # changes MuJoCo's own memory
    assert same(advance(state, control), once)
    order = np.random.default_rng(0).permutation(7)
    shuffled = advance(jax.tree.map(lambda leaf: leaf[order], state), control[order])
    assert same(shuffled, jax.tree.map(lambda leaf: leaf[order], once))


def test_one_robot_moves_alone_as_among_others(ant):
    physics, model, advance = ant
    state, control = robots(physics, model, 5)
    together = advance(advance(state, control), control)
    step = jax.jit(physics.advance)
    for i in range(5):
        own = jax.tree.map(lambda leaf, i=i: leaf[i], state)
        alone = step(step(own, control[i]), control[i])
        assert same(alone, jax.tree.map(lambda leaf, i=i: leaf[i], together))


@pytest.mark.parametrize("num_threads", [1, 2, 3, 8])
def test_the_number_of_threads_changes_nothing(ant, num_threads):
    physics, model, advance = ant
    state, control = robots(physics, model, 5)
    other = mujoco_c.make(setup_of("ant"), num_threads=num_threads)
    assert same(jax.jit(jax.vmap(other.advance))(state, control), advance(state, control))


def test_scans_and_nested_vmaps_are_one_call_each_step(ant, monkeypatch):
    physics, model, advance = ant
    state, control = robots(physics, model, 6)
    calls = []
    original = mujoco_c.Stepper.__call__

    def counting(self, rows):
        calls.append(len(rows))
        return original(self, rows)

    monkeypatch.setattr(mujoco_c.Stepper, "__call__", counting)
    grouped, controls = jax.tree.map(lambda leaf: leaf.reshape(2, 3, *leaf.shape[1:]), (state, control))

    @jax.jit
    def run(state):
        def step(state, _):
            return jax.vmap(jax.vmap(physics.advance))(state, controls), None

        return jax.lax.scan(step, state, length=4)[0]

    scanned = run(grouped)
    assert calls == [6] * 4
    for _ in range(4):
        state = advance(state, control)
    assert same(jax.tree.map(lambda leaf: leaf.reshape(6, *leaf.shape[2:]), scanned), state)


def test_off_the_cpu_the_callback_gives_the_same(ant, monkeypatch):
    physics, model, advance = ant
    state, control = robots(physics, model, 3)
    expected = advance(state, control)
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *args, default, cpu: default(*args))
    assert same(jax.jit(jax.vmap(physics.advance))(state, control), expected)


@pytest.mark.parametrize("name", [name for name, task in TASKS.items() if task.quantities])
def test_first_observations_are_gymnasiums(name):
    """Also after other robots have moved in MuJoCo's memory, which keeps their forces."""
    rows, env = recorded(name), envs.make(name, "mujoco")
    place, step = jax.jit(jax.vmap(env.set_physics)), jax.jit(jax.vmap(env.step))
    step(place(rows.qpos, rows.qvel), jnp.ones_like(rows.action))
    np.testing.assert_allclose(place(rows.qpos, rows.qvel).obs, rows.first_obs, rtol=1e-5, atol=1e-5)


def test_robots_are_placed_alike_in_any_batch_and_off_the_cpu(monkeypatch):
    setup = setup_of("humanoid")
    physics, generator = mujoco_c.make(setup), np.random.default_rng(0)
    qpos = jnp.float32(setup.model.qpos0 + generator.uniform(-0.1, 0.1, (2, 3, setup.model.nq)))
    qvel = jnp.float32(generator.normal(size=(2, 3, setup.model.nv)))
    together = jax.jit(jax.vmap(jax.vmap(physics.place)))(qpos, qvel)
    assert np.ptp(together.quantities["cinert"], axis=(0, 1)).max() > 0.01
    assert same(physics.place(qpos[1, 2], qvel[1, 2]), jax.tree.map(lambda leaf: leaf[1, 2], together))
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *args, default, cpu: default(*args))
    assert same(jax.jit(jax.vmap(physics.place))(qpos[1], qvel[1]), jax.tree.map(lambda leaf: leaf[1], together))


def test_the_state_is_carried_in_float64(ant):
    physics, model, advance = ant
    state, control = robots(physics, model, 1)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = state.qpos[0], state.qvel[0], control[0]
    for _ in range(20):
        state = advance(state, control)
        mujoco.mj_step(model, data, nstep=5)
    words = np.asarray(state.internal[0])
    assert words[0] == 1
    carried = words[1:].view(np.float64)[1:]
    np.testing.assert_array_equal(carried, np.concatenate([data.qpos, data.qvel, data.qacc_warmstart]))
    np.testing.assert_array_equal(state.qpos[0], data.qpos.astype(np.float32))


@pytest.mark.parametrize("fault", [np.nan, np.inf, 1e11])
def test_a_diverged_robot_ends_its_episode_and_no_other(fault, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    env = envs.make("ant", "mujoco")
    gym_tasks.load_model(TASKS["cheetah"])  # it sets MuJoCo's warning handler too
    timestep = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 3))
    qvel = timestep.state.task.qvel.at[1, 2].set(fault)
    broken = jax.vmap(env.set_physics)(timestep.state.task.qpos, qvel)
    step = jax.jit(jax.vmap(env.step))
    after = step(broken, jnp.zeros((3, 8)))
    assert after.terminated.tolist() == [False, True, False]
    assert all(np.all(np.isfinite(x)) for x in (after.obs, after.reward, after.final_obs[jnp.array([0, 2])]))
    assert after.reward[1] == 0
    assert jax.vmap(env.status)(after)["unstable_steps"].tolist() == [0, 1, 0]
    going_on = step(after, jnp.zeros((3, 8)))
    assert np.all(np.isfinite(going_on.final_obs)) and not going_on.terminated.any()
    assert list(tmp_path.iterdir()) == []  # MuJoCo wrote no log
    assert capfd.readouterr().err == ""


def test_a_warning_handler_of_the_user_stays(ant):
    physics, model, advance = ant
    heard = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(heard.append)
    try:
        state, control = robots(physics, model, 2)
        advance(state._replace(internal=state.internal.at[0, 3].set(jnp.uint32(0x7FC00000))), control)
        gym_tasks.load_model(TASKS["cheetah"])
        mine = mujoco.get_mju_user_warning()
        mine("heard")
    finally:
        mujoco.set_mju_user_warning(before)
    assert "heard" in heard


@pytest.mark.parametrize("count", [1, 6])  # one is stepped by the caller, six by the pool
def test_programs_in_several_threads_do_not_disturb_each_other(ant, count):
    physics, model, advance = ant
    state, control = robots(physics, model, count)
    expected = advance(state, control)
    threads._pools.clear()  # so that all of them make a pool at the same time
    fresh = mujoco_c.make(setup_of("ant"), num_threads=2)
    step = jax.jit(jax.vmap(fresh.advance))
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        results = list(pool.map(lambda _: jax.block_until_ready(step(state, control)), range(40)))
    assert all(same(result, expected) for result in results)
    assert len(threads._pools) == (count > 1)


def test_zero_threads_are_rejected():
    with pytest.raises(ValueError, match="num_threads: expected a whole number of at least 1, got 0"):
        mujoco_c.make(setup_of("ant"), num_threads=0)


def test_activation_states_are_rejected():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='j'/><geom size='.1'/></body></worldbody><actuator>"
        "<general joint='j' dyntype='integrator'/></actuator></mujoco>"
    )
    with pytest.raises(ValueError, match="expected no activation states, got 1"):
        mujoco_c.make(Setup(model, 1))
