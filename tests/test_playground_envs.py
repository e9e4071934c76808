"""Playground's environments through our contract: the same steps, new starts, the true last observation, no waste."""

import subprocess
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params
from made_runs import write_run

from experiments import play, report, tables
from experiments.commandline.arguments import UsageError
from experiments.evidence import finished_runs
from experiments.playing import graphics, rendering
from experiments.playing.played_task import make_played_task
from experiments.run import main
from sqt_jax import envs
from sqt_jax.config import ConfigError
from sqt_jax.envs import physics, playground_envs
from sqt_jax.experiment import make_config, named_env

CARTPOLE = "playground:CartpoleBalance"
FAKE = "playground:Fake"
# One environment of each model in Playground's suite; the others differ in their rewards and starts only.
MODELS = ["AcrobotSwingup", "BallInCup", "CartpoleSwingupSparse", "CheetahRun", "FingerSpin", "FingerTurnHard"]
MODELS += ["FishSwim", "HopperHop", "HumanoidWalk", "PendulumSwingup", "PointMass", "ReacherEasy", "SwimmerSwimmer6"]
MODELS += ["WalkerRun"]
TINY = ["--steps=60", "--warmup_steps=20", "--eval_every=60", "--eval_episodes=1", "--hidden=8", "--batch_size=8"]


# Without the package: names, settings, records


@pytest.fixture
def missing(monkeypatch):
    """As if Playground were not installed."""
    monkeypatch.setattr(playground_envs, "find_spec", lambda name: None)


def test_a_name_is_known_without_the_package(missing):
    assert envs.resolve(CARTPOLE) == CARTPOLE and envs.resolve("playground:NoSuch") == "playground:NoSuch"
    assert envs.physics_of(CARTPOLE) == ("mjx", "warp") and envs.takes_arguments(CARTPOLE)
    assert not envs.is_built_in(CARTPOLE)
    config = make_config("td3", CARTPOLE, env_args="reward_config.scales.energy=-1", max_episode_steps=50)
    assert (config.env, config.physics, config.max_episode_steps) == (CARTPOLE, "mjx", 50)


@pytest.mark.parametrize(
    "name", ["playground:", "playground:a:b", "playground:Cart-pole", "playground:1", "playground:é"]
)
def test_other_forms_are_rejected(name):
    with pytest.raises(ConfigError, match="--env: expects playground:NAME, as in playground:CartpoleBalance, not "):
        make_config("td3", name)


def test_other_physics_are_rejected():
    with pytest.raises(ConfigError, match="--physics: expects one of mjx, warp, not 'mujoco' for playground:"):
        make_config("td3", CARTPOLE, physics="mujoco")
    with pytest.raises(ConfigError, match="--eval_physics: expects one of auto, mjx, warp, not 'mujoco'"):
        make_config("td3", CARTPOLE, eval_physics="mujoco")


def test_the_extra_is_named_where_it_is_missing(missing, tmp_path, capsys):
    assert main(["run", "--algo=td3", f"--env={CARTPOLE}", f"--out={tmp_path}"]) == 2
    assert capsys.readouterr().err == f"--env={CARTPOLE}: needs the extra: pip install -e '.[playground]'\n"
    assert not list(tmp_path.iterdir())
    with pytest.raises(UsageError, match="needs the extra"):
        make_played_task(make_config("td3", CARTPOLE), None, "")


def test_warp_needs_what_it_needs_elsewhere(missing, monkeypatch):
    monkeypatch.setitem(physics.LACKS, "warp", lambda: "a part")
    with pytest.raises(ValueError, match="physics warp needs a part"):
        envs.make(CARTPOLE, "warp")


def test_runs_are_read_without_the_package(missing, tmp_path):
    path = write_run(tmp_path, "td3", CARTPOLE, [[0, 1], [0, 2]])
    found, left_out = finished_runs.find([str(tmp_path)])
    assert list(found) == [path] and not left_out


@pytest.mark.slow
def test_tables_and_report_do_not_need_the_package(missing, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path / "runs", "td3", CARTPOLE, [[0, 1], [0, 2]])
    assert tables.main(["tables", "runs"]) == 0 and report.main(["report", "runs", "--out=report.html"]) == 0
    assert CARTPOLE in capsys.readouterr().out and CARTPOLE in (tmp_path / "report.html").read_text()


# With the package


@pytest.fixture(scope="module")
def playground():
    return pytest.importorskip("mujoco_playground", reason="needs the extra playground")


@pytest.fixture
def fake(playground, monkeypatch):
    """An environment without physics in Playground's suite: a number that grows by the action, until it is above 2.

    Its reward is the number. Its start makes 200 steps. Like Playground's, it writes into the `info` it is given.
    """
    from ml_collections import config_dict
    from mujoco_playground import State, dm_control_suite

    def config():
        nested = {"scales": {"energy": 1.0}}
        values = {"ctrl_dt": 0.02, "sim_dt": 0.01, "episode_length": 7, "action_repeat": 1, "rewards": nested}
        return config_dict.create(**values, impl="warp", observed="state")

    class Fake(playground.MjxEnv):
        action_size, mj_model, xml_path = 1, None, ""

        @property
        def mjx_model(self):
            return SimpleNamespace(impl=SimpleNamespace(value=self._config.impl))

        def observe(self, x):
            return {self._config.observed: jnp.stack([x, self._config.rewards.scales.energy * x]), "privileged": x}

        def reset(self, rng):
            x = jax.random.uniform(rng, (), maxval=0.1)
            x = jax.lax.scan(lambda x, _: (x * 0.99, None), x, length=200)[0]
            info = {"rng": rng, "steps": 0}  # a number of Python's, as some environments have it
            return State(x, self.observe(x), jnp.zeros(()), jnp.zeros(()), {"reward/x": 0.0}, info)

        def step(self, state, action):
            x = state.data + action[0]
            state.info["steps"] += 1
            state.metrics["reward/x"] = x
            reward = jnp.where(state.info["steps"] == 6, jnp.nan, x)
            return State(x, self.observe(x), reward, (x > 2).astype(float), state.metrics, state.info)

    for table, value in {"_envs": Fake, "_cfgs": config}.items():
        monkeypatch.setitem(getattr(dm_control_suite, table), "Fake", value)
    before = playground.registry.ALL_ENVS
    monkeypatch.setattr(playground.registry, "ALL_ENVS", (*before, "Fake"))
    return Fake


def made(arguments=None, **options):
    return envs.make(FAKE, arguments=arguments, **options)


def test_the_observation_is_the_part_that_the_actor_sees(fake, playground):
    env = made({"rewards.scales.energy": 10})
    assert (env.observation_size, env.action_size, env.episode_length) == (2, 1, 7)
    assert env.version.startswith("playground ") and env.min_mean_episode_length == 7
    timestep = env.reset(jax.random.key(0))
    np.testing.assert_allclose(timestep.obs[1], 10 * timestep.obs[0])


def test_steps_are_pure_and_compile_once(fake):
    env = made()
    step = jax.jit(env.step)
    start = env.reset(jax.random.key(0))
    kept = jax.tree.map(jnp.copy, start.state.task.info)
    for again in (env.step(start, jnp.ones(1)), step(start, jnp.ones(1))):
        assert again.state.task.info["steps"] == 1 and start.state.task.info["steps"] == kept["steps"] == 0
    step(step(start, jnp.ones(1)), jnp.ones(1))
    assert step._cache_size() == 1
    assert {leaf.dtype for leaf in jax.tree.leaves(start)} <= {
        jax.random.key(0).dtype,
        *map(jnp.dtype, ("float32", "int32", "uint32", "bool")),
    }


def test_an_episode_ends_with_its_own_observation_and_the_next_has_a_new_start(fake):
    env = made()
    step = jax.jit(env.step)
    timestep = env.reset(jax.random.key(0))
    starts = [timestep.obs[0]]
    for number in range(1, 7):
        timestep = step(timestep, jnp.ones(1))
        ended = number % 2 == 0  # at 1 and 2 above the start
        assert bool(timestep.terminated) == ended and not timestep.truncated
        assert 0 < timestep.reward - (2 if ended else 1) < 0.1
        np.testing.assert_allclose(timestep.final_obs[0], timestep.reward, rtol=1e-6)
        if ended:
            starts.append(timestep.obs[0])
            assert timestep.state.task.info["steps"] == 0
    assert len(np.unique(starts)) == 4 and max(starts) < 0.1


def test_the_time_limit_truncates_and_a_diverged_step_terminates(fake):
    env = made(max_episode_steps=5)
    assert env.episode_length == 5
    step = jax.jit(env.step)
    timestep = env.reset(jax.random.key(0))
    ends = [bool((timestep := step(timestep, jnp.zeros(1))).truncated) for _ in range(10)]
    assert ends == 2 * [False, False, False, False, True]
    env = made()
    step, timestep = jax.jit(env.step), env.reset(jax.random.key(0))
    for _ in range(6):
        timestep = step(timestep, jnp.zeros(1))
    assert timestep.terminated and timestep.reward == 0 and env.status(timestep)["unstable_steps"] == 1


def test_an_action_is_repeated_until_an_episode_ends(fake):
    env = made({"action_repeat": 2})
    assert env.episode_length == 4  # of 7 steps of Playground's, the last one of ours passes the limit
    step, timestep = jax.jit(env.step), env.reset(jax.random.key(0))
    x = timestep.obs[0]
    timestep = step(timestep, jnp.ones(1))
    np.testing.assert_allclose(timestep.reward, (x + 1) + (x + 2), rtol=1e-6)
    assert timestep.terminated  # above 2
    x = timestep.obs[0]
    timestep = step(timestep, 0.3 * jnp.ones(1))
    timestep = step(timestep, jnp.ones(1))
    np.testing.assert_allclose(timestep.reward, (x + 1.6) + (x + 2.6), rtol=1e-6)
    env = made({"action_repeat": 5})
    start = env.reset(jax.random.key(0))
    timestep = jax.jit(env.step)(start, jnp.ones(1))
    np.testing.assert_allclose(timestep.reward, (start.obs[0] + 1) + (start.obs[0] + 2), rtol=1e-6)
    assert timestep.terminated


def loops(jaxpr, conditional=False):
    """Of each loop of a fixed length: the length, and whether it is in a branch of a condition."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "scan":
            yield equation.params["length"], conditional
        for sub in jaxprs_in_params(equation.params):
            yield from loops(sub, conditional or equation.primitive.name == "cond")


def test_a_start_is_computed_only_where_an_episode_ends(fake):
    assert_starts_are_conditional(made(), 200)


def assert_starts_are_conditional(env, length):
    def step(keys, actions):
        return jax.vmap(env.step)(jax.vmap(env.reset)(keys), actions)

    keys, actions = jax.random.split(jax.random.key(0), 3), jnp.zeros((3, env.action_size))
    timesteps = jax.eval_shape(jax.vmap(env.reset), keys)
    found = list(loops(jax.make_jaxpr(jax.vmap(env.step))(timesteps, actions).jaxpr))
    assert [conditional for number, conditional in found if number == length] == [True]  # and compiled once
    assert (length, False) in loops(jax.make_jaxpr(step)(keys, actions).jaxpr)  # the search finds one that is not


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"rewards.scale.energy": 1},
            "env_args: its configuration has no entry rewards.scale.energy; did you mean r",
        ),
        ({"rewards": 1}, "env_args: its configuration has no entry rewards"),
        ({"impl": "jax"}, "env_args: expects --physics instead of impl"),
        ({"ctrl_dt": "fast"}, "env_args: TypeError: Could not override field 'ctrl_dt'"),
        ({"ctrl_dt": 0.001}, "expects a ctrl_dt of at least sim_dt, not 0.001 and 0.01"),
        ({"sim_dt": 0.0}, "ZeroDivisionError"),
        ({"action_repeat": 0}, "expects a positive whole number as action_repeat, not 0"),
        ({"episode_length": True}, "expects a positive whole number as episode_length, not True"),
        ({"observed": "pixels"}, "expects a vector as observation, or a dictionary with the vector 'state', not {'pi"),
    ],
)
def test_wrong_arguments_are_rejected_in_one_line(fake, arguments, message):
    with pytest.raises(ValueError) as error:
        made(arguments)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_the_time_limit_is_given_once(fake):
    with pytest.raises(ValueError, match="env_args: expects no episode_length with --max_episode_steps"):
        made({"episode_length": 5}, max_episode_steps=5)


def test_an_implementation_that_is_not_the_physics_is_rejected(fake, monkeypatch):
    """One of Playground's has no choice of it in its configuration."""
    monkeypatch.setattr(fake, "mjx_model", SimpleNamespace(impl=SimpleNamespace(value="warp")))
    with pytest.raises(ValueError, match="computes with MJX's implementation warp only: expects another --physics"):
        made()


def test_settings_reach_the_environment(fake):
    config = make_config("td3", FAKE, env_args="rewards.scales.energy=3,action_repeat=2", max_episode_steps=9)
    env = named_env(config, "mjx")
    assert env.episode_length == 5
    obs = env.reset(jax.random.key(0)).obs
    np.testing.assert_allclose(obs[1], 3 * obs[0], rtol=1e-6)


def test_an_unknown_name_is_rejected(playground):
    with pytest.raises(ValueError, match="Playground has no such environment; did you mean playground:CartpoleBalance"):
        envs.make("playground:CartpoleBalanc")


def test_robots_need_their_models(playground, monkeypatch, tmp_path):
    from mujoco_playground._src import mjx_env

    def fails(*args, **options):
        raise subprocess.TimeoutExpired("git", options["timeout"])

    folder = tmp_path / "menagerie"
    monkeypatch.setattr(mjx_env, "MENAGERIE_PATH", folder)
    monkeypatch.setattr(subprocess, "run", fails)
    with pytest.raises(ValueError) as error:
        envs.make("playground:Go1Getup")
    says = str(error.value)
    assert says.startswith("needs the robots' models, which git cannot download here: clone https://github.com/google")
    assert says.endswith(f", and copy it to {folder}") and "\n" not in says
    monkeypatch.setattr(subprocess, "run", lambda *args, **options: None)  # git can
    playground_envs._check_robots()
    monkeypatch.setattr(subprocess, "run", fails)
    folder.mkdir()
    playground_envs._check_robots()


def test_loading_leaves_no_traces(playground, tmp_path, monkeypatch, capfd):
    """CheetahRun's model makes MuJoCo warn; ReacherEasy calls a method that MuJoCo has renamed."""
    import mujoco

    monkeypatch.chdir(tmp_path)
    before = mujoco.get_mju_user_warning(), dir(mujoco.MjSpec)
    for name in ("CheetahRun", "ReacherEasy"):
        assert playground_envs.load(f"playground:{name}", "mjx").steps == 1000
    assert (mujoco.get_mju_user_warning(), dir(mujoco.MjSpec)) == before
    assert not list(tmp_path.iterdir()) and capfd.readouterr() == ("", "")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["CartpoleBalance", "PendulumSwingup"])
def test_steps_are_playgrounds(playground, name):
    """Its own reset and step, driven by hand from our keys and actions, over three short episodes."""
    length = 12
    env = envs.make(f"playground:{name}", max_episode_steps=length)
    own = playground.registry.load(name, config_overrides={"impl": "jax"})
    step, own_reset, own_step = jax.jit(env.step), jax.jit(own.reset), jax.jit(own.step)
    key = jax.random.key(3)
    timestep, starts = env.reset(key), []
    for _ in range(3):
        start_key, key = jax.random.split(key)
        state = own_reset(jax.random.key_data(start_key))
        np.testing.assert_allclose(timestep.obs, state.obs, rtol=1e-5, atol=1e-6)
        starts.append(timestep.obs)
        for number in range(1, length + 1):
            action = jax.random.uniform(jax.random.fold_in(key, number), (env.action_size,), minval=-1, maxval=1)
            timestep, state = step(timestep, action), own_step(state, action)
            np.testing.assert_allclose(timestep.final_obs, state.obs, rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(timestep.reward, state.reward, rtol=1e-4, atol=1e-6)
            assert bool(timestep.terminated) == bool(state.done) == False  # noqa: E712
            assert bool(timestep.truncated) == (number == length)
    assert len(np.unique(np.array(starts), axis=0)) == 3


@pytest.mark.slow
def test_a_cheetahs_start_of_200_steps_is_not_computed_at_every_step(playground):
    env = envs.make("playground:CheetahRun")
    assert_starts_are_conditional(env, 200)
    step = jax.jit(jax.vmap(env.step))
    timestep = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2))
    for _ in range(5):
        timestep = step(timestep, jnp.ones((2, 6)))
    assert np.isfinite(timestep.obs).all() and (timestep.reward >= 0).all() and not timestep.truncated.any()
    assert step._cache_size() == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_every_model_of_the_suite_steps(playground, name):
    """Traced, not compiled."""

    def shapes(timestep):
        leaves, structure = jax.tree.flatten(timestep)
        return [(leaf.shape, leaf.dtype, leaf.weak_type) for leaf in leaves], structure

    model = playground_envs.load(f"playground:{name}", "mjx").env.mj_model
    assert model.actuator_ctrllimited.all() and set(model.actuator_ctrlrange.flat) == {-1.0, 1.0}  # as our actions
    env = envs.make(f"playground:{name}")
    timestep = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, timestep, jax.ShapeDtypeStruct((env.action_size,), jnp.float32))
    assert after.obs.shape == (env.observation_size,) and env.min_mean_episode_length == env.episode_length == 1000
    assert shapes(after) == shapes(timestep)


@pytest.mark.slow
def test_a_run_trains_resumes_and_is_played(playground, tmp_path, monkeypatch, capsys):
    argv = ["run", "--algo=td3_sqt", f"--env={CARTPOLE}", *TINY, f"--out={tmp_path}", "--name=tiny", "--quiet"]
    argv += ["--seeds=0,1", "--max_episode_steps=40", "--checkpoint_every=60", "--devices=1"]
    assert main(argv) == 0
    run = tmp_path / "playground-CartpoleBalance" / "td3_sqt" / "tiny"
    assert main(["run", f"--resume={run}", "--steps=80", "--quiet"]) == 0
    capsys.readouterr()

    drawn = []

    def frames(model, configurations, size, camera):
        for configuration in configurations:
            drawn.append(configuration)
            yield np.full((size[1], size[0], 3), 100, np.uint8)

    monkeypatch.setattr(rendering, "frames", frames)
    monkeypatch.setattr(graphics, "choose", lambda: "glfw")
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    film = tmp_path / "film.mp4"
    assert play.main(["play", str(run), f"--video={film}", "--size=32x16", "--member=1"]) == 0
    assert "40 steps, 0.4 s, ended by the time limit" in capsys.readouterr().out
    assert film.stat().st_size > 0 and np.array(drawn).shape == (20, 2)  # 100 steps/s, and 50 pictures/s
