"""The physics `mjx`; its agreement with MuJoCo C on the tasks is in test_gymnasium_parity."""

from importlib.metadata import version

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from gym_reference import COUNT, MJX_TASKS, compiled_step, environment, ours, placed, recorded

from sqt_jax import envs
from sqt_jax.envs import TASKS, gym_tasks
from sqt_jax.envs.physics import Setup, mjx

# a free capsule and a hinged arm over a plane, with a capsule-plane contact
MODEL = """
<mujoco>
  <option timestep="0.01" integrator="{integrator}"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 {height}">
      <freejoint/>
      <geom type="capsule" fromto="0 0 -.3 0 0 .3" size=".1"/>
      <body pos="0 0 .3">
        <joint name="arm" axis="0 1 0" damping=".1"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".05" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="arm" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def model_of(integrator="RK4", height=2.0):
    return mujoco.MjModel.from_xml_string(MODEL.format(integrator=integrator, height=height))


def tilted(degrees):
    """A quaternion that tilts the capsule so far from upright, in a direction that is no axis of the plane."""
    half = np.radians(degrees) / 2
    return np.array([np.cos(half), -0.6 * np.sin(half), 0.8 * np.sin(half), 0])


def test_mujoco_and_mjx_are_the_same_version():
    # different versions install together without complaint, and their physics differ
    assert version("mujoco") == version("mujoco-mjx")


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
@pytest.mark.slow
def test_both_integrators_follow_mujoco_in_free_flight(integrator):
    model = model_of(integrator)
    physics = mjx.make(Setup(model, 5, tracked=lambda model, data: data.xpos[1, 0]))
    data = mujoco.MjData(model)
    data.qvel[:] = [0.5, -0.4, 0.3, 2, -1, 3, 4]
    data.ctrl[:] = 0.5
    state = jax.jit(physics.place)(data.qpos, data.qvel)
    advance = jax.jit(physics.advance)
    x = 0.0
    for _ in range(4):
        mujoco.mj_step(model, data, nstep=5)
        state = advance(state, jnp.array([0.5]))
        np.testing.assert_allclose(state.displacement, data.xpos[1, 0] - x, atol=1e-6)  # of the last evaluation
        x = data.xpos[1, 0]
    np.testing.assert_allclose(state.qpos, data.qpos, atol=3e-6)
    np.testing.assert_allclose(state.qvel, data.qvel, atol=2e-5)


@pytest.mark.parametrize("degrees", [80, 45, 20, 5])
def test_friction_of_a_capsule_on_a_plane_follows_mujoco_at_every_angle(degrees, sliding):
    model, advance, place = sliding
    data = mujoco.MjData(model)
    data.qpos[3:7] = tilted(degrees)
    data.qpos[2] = 0.3 * np.cos(np.radians(degrees)) + 0.1 - 0.002  # 2 mm in the plane
    data.qvel[:2] = 0.7, 0.2
    state = place(data.qpos, data.qvel)
    mujoco.mj_step(model, data)
    state = advance(state, jnp.zeros(1))
    assert data.ncon > 0
    np.testing.assert_allclose(state.qvel, data.qvel, atol=1e-4)


@pytest.fixture(scope="module")
def sliding():
    model = model_of("Euler")
    physics = mjx.make(Setup(model, 1))
    return model, jax.jit(physics.advance), jax.jit(physics.place)


@pytest.mark.slow
def test_models_own_solver_settings_are_reachable_and_give_the_same_step():
    env = envs.make("cheetah", iterations=None, ls_iterations=None)
    rows, (first, after) = recorded("cheetah"), ours("cheetah")
    exact = jax.jit(jax.vmap(env.step))(first, rows.action)
    error = np.abs(exact.final_obs - after.final_obs)
    assert np.median(error) < 1e-5
    assert error.max() < 5e-3


@pytest.mark.parametrize("name", ["iterations", "ls_iterations"])
def test_a_solver_without_steps_is_rejected(name):
    with pytest.raises(ValueError, match=f"{name}: expected a whole number of at least 1, .* got 0"):
        envs.make("ant", **{name: 0})


@pytest.mark.parametrize(("options", "expected"), [({}, (8, 8)), ({"iterations": 3, "ls_iterations": 5}, (3, 5))])
def test_solver_options_reach_the_solver(options, expected, monkeypatch):
    assert solver_settings(options, monkeypatch) == expected


def test_none_means_the_files_settings(monkeypatch):
    model = gym_tasks.load_model(TASKS["humanoid"])
    options = {"iterations": None, "ls_iterations": None}
    assert solver_settings(options, monkeypatch) == (model.opt.iterations, model.opt.ls_iterations)


def solver_settings(options, monkeypatch):
    seen = []
    put_model = mjx.mjx.put_model
    monkeypatch.setattr(mjx.mjx, "put_model", lambda model, **kw: seen.append(put_model(model, **kw)) or seen[-1])
    model = gym_tasks.load_model(TASKS["humanoid"])
    mjx.make(Setup(model, 5), **options)
    assert model.opt.solver == mujoco.mjtSolver.mjSOL_PGS  # the caller's model is not changed
    assert seen[0].opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    return seen[0].opt.iterations, seen[0].opt.ls_iterations


def test_unknown_options_and_integrators_are_rejected():
    with pytest.raises(TypeError, match="iteration"):
        envs.make("cheetah", iteration=3)
    with pytest.raises(ValueError, match="IMPLICITFAST"):
        mjx.make(Setup(model_of("implicitfast"), 1))


@pytest.mark.parametrize("name", ["cheetah", "humanoid"])
def test_state_is_small(name):
    # the arrays that a restart selects: qpos, qvel, warm start, the tracked point, quantities; not MJX's Data
    timestep = jax.eval_shape(envs.make(name).reset, jax.random.key(0))
    task = sum(leaf.size for leaf in jax.tree.leaves(timestep.state.task))
    assert task < timestep.obs.size + 40


def test_matrix_products_have_full_precision_in_any_program():
    env = envs.make("cheetah")
    timestep = jax.eval_shape(env.reset, jax.random.key(0))
    with (
        jax.default_matmul_precision("bfloat16"),
        jax.numpy_dtype_promotion("strict"),
        jax.numpy_rank_promotion("raise"),
    ):
        traced = jax.make_jaxpr(env.step)(timestep, jnp.zeros(6))
    precisions = [equation.params["precision"] for equation in equations(traced.jaxpr, "dot_general")]
    assert len(precisions) > 10
    highest = (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)
    # MJX asks for `HIGH` itself where meshes collide, of which there are none here
    assert set(precisions) == {highest}


def equations(jaxpr, primitive):
    for equation in jaxpr.eqns:
        if equation.primitive.name == primitive:
            yield equation
        for parameter in equation.params.values():
            for inner in jax.tree.leaves(parameter, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from equations(inner, primitive)


@pytest.mark.parametrize("name", [*MJX_TASKS, pytest.param("humanoid", marks=pytest.mark.slow)])
def test_first_state_is_at_rest_of_forces(name):
    timestep = placed(name)
    forces = {k: v for k, v in timestep.state.task.quantities.items() if k in ("qfrc_actuator", "cfrc_ext")}
    assert all(not np.any(v) for v in forces.values())
    assert not np.any(timestep.state.task.displacement)
    assert np.isfinite(timestep.obs).all()


@pytest.mark.slow  # on MuJoCo C it is fast: test_mujoco_c
@pytest.mark.parametrize("fault", [np.nan, np.inf, 1e11])
def test_a_diverged_robot_ends_its_episode_and_no_other(fault):
    first = placed("ant")
    broken = first.state.task._replace(qvel=first.state.task.qvel.at[1, 2].set(fault))
    broken = first._replace(state=first.state._replace(task=broken))
    expected, after = ours("ant")[1], compiled_step("ant")(broken, recorded("ant").action)
    others = np.arange(COUNT) != 1
    assert after.terminated[1] and after.reward[1] == 0
    np.testing.assert_array_equal(after.terminated[others], expected.terminated[others])
    np.testing.assert_array_equal(after.final_obs[1], first.obs[1])
    assert all(np.all(np.isfinite(x)) for x in (after.obs, after.reward, after.final_obs))
    assert jax.vmap(environment("ant").status)(after)["unstable_steps"].tolist() == (~others).astype(int).tolist()
