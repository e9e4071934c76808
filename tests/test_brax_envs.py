"""Brax's environments through our contract: the same steps, new starts, the true last observation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.run import main
from sqt_jax import envs
from sqt_jax.config import ConfigError
from sqt_jax.envs.brax_envs import NAMES, PHYSICS, brax_own
from sqt_jax.experiment import make_config

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Brax's own
NAME = "brax:inverted_pendulum"  # the smallest: it compiles in seconds


@pytest.fixture(scope="module")
def pendulum():
    env = envs.make(NAME, "spring")
    return env, jax.jit(env.step)


def test_the_names_are_braxs_except_its_test_environment():
    from brax import envs as theirs

    assert {name.removeprefix("brax:") for name in NAMES} == set(theirs._envs) - {"fast"}


@pytest.mark.slow
def test_steps_are_braxs(pendulum):
    from brax import envs as theirs

    env, step = pendulum
    original = theirs.get_environment("inverted_pendulum", backend="spring")
    timestep = env.reset(jax.random.key(3))
    state = timestep.state.task
    np.testing.assert_array_equal(timestep.obs, state.obs)
    their_step = jax.jit(original.step)
    for action in (0.3, -0.2, 0.1):
        timestep, state = step(timestep, jnp.full(1, action)), their_step(state, jnp.full(1, action))
        np.testing.assert_allclose(timestep.final_obs, state.obs, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(timestep.reward, state.reward, rtol=1e-6)


@pytest.mark.slow  # the contract itself: test_envs
def test_an_episode_ends_with_its_own_observation_and_the_next_has_a_new_start(pendulum):
    env, step = pendulum
    timestep = env.reset(jax.random.key(0))
    starts = [timestep.obs]
    for _ in range(300):
        timestep = step(timestep, jnp.ones(1))
        if timestep.terminated:
            assert abs(timestep.final_obs[1]) > 0.2  # the fallen pole
            starts.append(timestep.obs)
        else:
            np.testing.assert_array_equal(timestep.final_obs, timestep.obs)
    assert len(starts) >= 3
    assert len(np.unique(np.array(starts), axis=0)) == len(starts)
    assert np.abs(np.array(starts)).max() <= 0.05


@pytest.mark.slow  # as above
def test_the_time_limit_truncates(pendulum):
    env, step = pendulum
    timestep = env.reset(jax.random.key(0))
    late = timestep._replace(state=timestep.state._replace(steps=jnp.int32(999)))
    assert step(late, jnp.zeros(1)).truncated and not step(timestep, jnp.zeros(1)).truncated


SLOW = {name: pytest.param(name, marks=pytest.mark.slow) for name in ("mjx", "generalized", "positional")}


@pytest.mark.parametrize("physics", [SLOW.get(name, name) for name in PHYSICS])
def test_every_physics_makes_steps_and_compiles_once(physics):
    env = envs.make(NAME, physics)
    assert (env.observation_size, env.action_size, env.name) == (4, 1, NAME)
    step = jax.jit(env.step)
    timestep = jax.jit(env.reset)(jax.random.key(0))
    for _ in range(3):
        timestep = step(timestep, jnp.ones(1))
        assert timestep.obs.shape == (4,) and np.all(np.isfinite(timestep.obs)) and timestep.reward == 1
    assert step._cache_size() == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_environment_steps_on_each_of_its_physics(name):
    """Traced, not compiled."""

    def shapes(timestep):
        # Not the trees themselves: MJX's classes hold NumPy arrays as constants, which their `==` cannot compare.
        leaves, structure = jax.tree.flatten(timestep)
        return [(leaf.shape, leaf.dtype) for leaf in leaves], structure

    for physics in envs.physics_of(name):
        env = envs.make(name, physics)
        timestep = jax.eval_shape(env.reset, jax.random.key(0))
        after = jax.eval_shape(env.step, timestep, jax.ShapeDtypeStruct((env.action_size,), jnp.float32))
        assert after.obs.shape == (env.observation_size,)
        assert shapes(after) == shapes(timestep)


@pytest.mark.slow
def test_a_run_trains_on_brax(tmp_path):
    argv = ["run", "--algo=td3_sqt", f"--env={NAME}", "--physics=spring", "--steps=60", "--warmup_steps=20"]
    argv += ["--eval_every=60", "--eval_episodes=1", "--hidden=8", "--batch_size=8", f"--out={tmp_path}", "--name=tiny"]
    assert main([*argv, "--quiet", "--seeds=0,1"]) == 0
    assert (tmp_path / NAME / "td3_sqt" / "tiny" / "policy" / "member_1.npz").exists()


def test_the_swimmers_only_physics_is_its_default():
    assert envs.physics_of("brax:swimmer") == ("generalized",)
    assert make_config("td3", "brax:swimmer").physics == "generalized"
    with pytest.raises(ConfigError, match="--physics: expects one of generalized, not 'mjx' for brax:swimmer"):
        make_config("td3", "brax:swimmer", physics="mjx")
    with pytest.raises(ConfigError, match="--eval_physics: expects one of auto, generalized, not 'spring'"):
        make_config("td3", "brax:swimmer", eval_physics="spring")


def test_the_swimmers_fluid_forces_can_be_computed_and_brake():
    """Brax computes them with a keyword that JAX has removed."""
    from brax import fluid
    from brax.base import Motion, Transform

    system = brax_own("brax:swimmer", "generalized").sys
    links = (system.num_links(),)
    inertia = system.link.inertia
    moving = Motion(ang=jnp.zeros((*links, 3)), vel=jnp.ones((*links, 3)))
    force = fluid.force(system, Transform.zero(links), moving, inertia.mass, inertia.i)
    assert np.isfinite(force.vel).all() and (force.vel.sum(axis=1) < 0).all()


@pytest.mark.parametrize(
    ("name", "physics", "message"),
    [
        ("brax:ant", "mujoco", "physics: expects one of mjx, generalized, spring, positional, not 'mujoco'"),
        ("ant", "spring", "physics: expects one of mjx, mujoco, warp, not 'spring'"),
        ("brax:antt", "mjx", "not 'brax:antt'; did you mean brax:ant?"),
    ],
)
def test_unknown_names_and_physics_are_rejected(name, physics, message):
    with pytest.raises(ValueError) as error:
        envs.make(name, physics)
    assert message in str(error.value)
