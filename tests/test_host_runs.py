"""Runs on environments of Gymnasium, from the command line to the film."""

import csv
import functools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from host_tasks import Counter

import sqt_jax
from experiments import play, report, run, tables
from experiments.commandline import flags
from sqt_jax.envs.gym_ids import from_gymnasium
from sqt_jax.experiment import make_trainer
from sqt_jax.members import Layout
from sqt_jax.types import Scalars

COUNTER = "gym:host_tasks:Counter-v0"
TINY = ["--algo=td3_sqt", "--seeds=0,1", "--steps=200", "--warmup_steps=100", "--eval_every=100", "--eval_episodes=1"]
TINY += ["--hidden=8", "--batch_size=8", "--checkpoint_every=50", "--notensorboard"]


def run_tiny(*arguments, env=COUNTER):
    return run.main(["run", *TINY, f"--env={env}", *arguments])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path / "runs/gym-host_tasks-Counter-v0/td3_sqt"


@pytest.mark.filterwarnings("ignore:.*Overriding environment", "ignore:an environment could not be closed")
def test_a_run_its_tables_its_report_and_its_film(folder, tmp_path, capsys):
    assert run_tiny("--name=a", "--env_args=bad_above=0.9,unruly=true") == 0
    os.chdir(tmp_path)  # the environment has left it
    assert " starts of gym:host_tasks:Counter-v0 had an observation" in capsys.readouterr().out
    content = json.loads((folder / "a/config.json").read_text())
    assert content["settings"]["env"] == COUNTER and content["settings"]["env_args"] == "bad_above=0.9,unruly=true"
    assert content["settings"]["physics"] == content["evaluated_on"] == "gymnasium"
    with (folder / "a/metrics.csv").open() as file:
        last = [*csv.DictReader(file)][-1]
    assert float(last["train_length"]) <= 5 and float(last["unstable_starts"]) > 0
    capsys.readouterr()
    sys.modules.pop("host_tasks")
    assert tables.main(["tables", "runs"]) == 0 and report.main(["report", "runs", "--out=r.html"]) == 0
    assert "host_tasks" not in sys.modules  # a file's names are not imported
    printed, page = capsys.readouterr().out, Path("r.html").read_text()
    assert COUNTER in printed and COUNTER in page and "bad_above=0.9,unruly=true" in page
    assert play.main(["play", str(folder / "a")]) == 2
    assert "imports a module" in capsys.readouterr().err and "host_tasks" not in sys.modules
    arguments = ["play", str(folder / "a"), f"--env={COUNTER}", "--episodes=2", "--video=film.gif"]
    assert play.main(arguments) == 0
    printed = capsys.readouterr().out
    assert printed.count("return ") == 2 and "film.gif: 22x16" in printed  # 21x15 pixels, padded
    assert (tmp_path / "film.gif").exists()


@pytest.mark.parametrize(("devices", "saved"), [(1, 136), pytest.param(2, 100, marks=pytest.mark.slow)])
def test_an_exception_ends_the_run_with_its_error_and_a_checkpoint(folder, capsys, devices, saved):
    """On one device of the step before; on several, members stop at different steps: the last one."""
    assert run_tiny("--name=a", "--env_args=fails_at=137", f"--devices={devices}") == 1
    printed = capsys.readouterr()
    line = printed.err.splitlines()[-1]
    assert line == (
        f"--env={COUNTER}: RuntimeError: the simulator is gone; traceback: runs/gym-host_tasks-Counter-v0/td3_sqt/a/"
        f"error.txt; the last checkpoint is of step {saved}"
    )
    assert "in step\n" in (error := (folder / "a/error.txt").read_text()) and "UTF-8: \\udcff" in error
    assert json.loads((folder / "a/summary.json").read_text())["status"] == "interrupted"
    # New environments have 136 steps more until the next exception.
    assert run.main(["run", f"--resume={folder / 'a'}"]) == 2
    assert "imports the module host_tasks" in capsys.readouterr().err
    assert run.main(["run", f"--resume={folder / 'a'}", f"--env={COUNTER}"]) == 0
    assert "new episodes begin" in capsys.readouterr().out and not (folder / "a/error.txt").exists()


def test_a_resumed_run_on_a_function_keeps_its_arguments_and_processes(monkeypatch):
    content = {
        "settings": {"env_args": "seconds=0.5", "max_episode_steps": 7},
        "output": {"env_processes": 3},
    }
    monkeypatch.setattr(run.run_config, "read", lambda path: SimpleNamespace(content=content))
    monkeypatch.setattr(run.factories, "make_from", lambda *arguments: arguments)

    def made(*more):
        return run.own_environment(flags.parse(["run", "--resume=x", "--env=host_tasks:counter", *more]))

    assert made() == ("host_tasks:counter", {"seconds": 0.5}, 7, 3)
    assert made("--env_processes=0") == ("host_tasks:counter", {"seconds": 0.5}, 7, 0)


@pytest.mark.slow
def test_processes_change_no_result(folder, capsys):
    assert run_tiny("--name=a", "--devices=1") == 0 and run_tiny("--name=b", "--env_processes=2") == 0

    def evaluations(name):
        rows = csv.DictReader((folder / name / "evaluations.csv").read_text().splitlines())
        return [{key: value for key, value in row.items() if "seconds" not in key} for row in rows]

    assert len(evaluations("a")) == 6 and evaluations("a") == evaluations("b")
    with np.load(folder / "a/policy/member_1.npz") as a, np.load(folder / "b/policy/member_1.npz") as b:
        assert all(np.array_equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env=gym:host_tasks:Endless-v0"], "--env=gym:host_tasks:Endless-v0: has no time limit"),
        (["--env_args=wings=2"], "--env=gym:host_tasks:Counter-v0: TypeError: "),
        (["--env_args=wings"], "--env_args: expects NAME=VALUE,... as in continuous=true,gravity=-9.8, not 'wings'"),
        (["--devices=2", "--env_processes=1"], "--devices=2: expects 1 with --env_processes"),
        (["--physics=mjx"], "--physics: expects one of gymnasium, not 'mjx'"),
        (["--env=ant", "--env_args=a=1"], "--env_args: has no effect with ant"),
        (["--env=ant", "--max_episode_steps=9"], "--max_episode_steps: has no effect with ant"),
        (["--env=cheetah", "--physics=mujoco", "--env_processes"], "--env_processes: has no effect with cheetah"),
        (["--env=gym:nope:A-v0"], "--env=gym:nope:A-v0: ModuleNotFoundError: No module named 'nope'"),
    ],
)
def test_bad_input_is_refused_in_one_line(folder, capsys, arguments, message):
    assert run_tiny(*arguments) == 2
    assert message in capsys.readouterr().err and not Path("runs").exists()


@pytest.mark.slow
def test_a_time_limit_makes_an_endless_environment_trainable(folder, capsys):
    assert run_tiny("--max_episode_steps=7", "--name=a", env="host_tasks:counter") == 0
    content = json.loads(Path("runs/host_tasks-counter/td3_sqt/a/config.json").read_text())
    assert content["settings"]["max_episode_steps"] == 7 and content["own_env"]["observation_size"] == 3
    assert play.main(["play", "runs/host_tasks-counter/td3_sqt/a", "--env=host_tasks:counter"]) == 0
    assert "7 steps" in capsys.readouterr().out


# The program.


def trained(env, steps=30, **settings):
    config = sqt_jax.make_config("td3_sqt", env, steps=60, warmup_steps=20, batch_size=4, hidden=(4,), **settings)
    trainer = make_trainer(config, env)
    sweep = sqt_jax.make_sweep(trainer)
    scalars = Scalars(*(jnp.full(2, value) for value in config.agent.scalars()))
    state = sweep.init(jax.vmap(jax.random.key)(jnp.arange(2)), scalars)
    return sweep, sweep.advance(state, steps, True)


def test_nothing_of_or_after_a_failed_step_is_learned_or_stored():
    env = from_gymnasium("counter", functools.partial(Counter, fails_at=8), 5)
    _, state = trained(env, 30)
    assert int(state.env_steps) == int(state.gradient_steps) == int(state.replay.inserted) == 7
    assert env.host.error().text == "RuntimeError: the simulator is gone"
    fine = from_gymnasium("counter", Counter, 5)
    _, before = trained(fine, 7)
    for name in ("agent", "replay", "episodes", "means"):
        for a, b in zip(jax.tree.leaves(getattr(state, name)), jax.tree.leaves(getattr(before, name)), strict=True):
            np.testing.assert_array_equal(a, b)


def test_devices_play_their_own_episodes_and_stop_when_one_of_them_fails():
    fails_at = [0, 8]  # of the environments that play; others are made to read their spaces

    def make():
        return Counter(fails_at=fails_at.pop() if playing else 0)

    config = sqt_jax.make_config("td3_sqt", "gym:Pendulum-v1", steps=5000, warmup_steps=4, batch_size=4, hidden=(4,))
    playing = False
    env = from_gymnasium("counter", make, 5)
    playing = True
    sweep = sqt_jax.make_sweep(make_trainer(config, env), Layout(2, tuple(jax.devices()[:2])))
    scalars = Scalars(*(jnp.full(2, value) for value in config.agent.scalars()))
    state = sweep.init(jax.vmap(jax.random.key)(jnp.arange(2)), scalars)
    steps = [int(shard.data) for shard in sweep.advance(state, 5000, False).env_steps.addressable_shards]
    assert 7 in steps and max(steps) < 5000
    assert env.host.error().text == "RuntimeError: the simulator is gone"


def test_one_program_without_a_copy_of_the_replay():
    env = from_gymnasium("counter", Counter, 5)
    sweep, state = trained(env)
    state = sweep.advance(sweep.advance(state, 3, False), 5, True)
    assert sweep.advance._cache_size() == 2  # the warm-up and training
    text = sweep.advance.lower(state, 3, True).compile().as_text()
    shape = f"f32[{','.join(map(str, state.replay.storage.shape))}]"
    assert shape in text
    assert not [line for line in text.splitlines() if " copy(" in line and shape in line.split(" copy(")[0]]


# Spaces: each trained, or refused in one line.

BOX = spaces.Box(-1, 1, (2,))
TRAINED = {
    "float64": (spaces.Box(-np.inf, np.inf, (3,), np.float64), BOX),
    "scalar": (spaces.Box(-1, 1, ()), spaces.Box(-2, 3, ())),
    "matrix": (spaces.Box(-1, 1, (2, 3)), spaces.Box(-1, 1, (2, 2))),
    "image": (spaces.Box(0, 255, (4, 4, 3), np.uint8), BOX),
    "integers": (spaces.Box(-5, 5, (2,), np.int64), spaces.Box(0, 9, (1,), np.int32)),
    "discrete": (spaces.Discrete(4, start=-1), BOX),
    "multidiscrete": (spaces.MultiDiscrete([2, 3]), BOX),
    "multibinary": (spaces.MultiBinary(3), BOX),
    "dict": (spaces.Dict({"a": BOX, "b": spaces.Discrete(2)}), BOX),
    "goal": (spaces.Dict({"observation": BOX, "achieved_goal": BOX, "desired_goal": BOX}), BOX),
    "tuple": (spaces.Tuple((BOX, spaces.MultiBinary(2))), BOX),
    "nested": (spaces.Dict({"a": spaces.Tuple((BOX, spaces.Dict({"c": spaces.Discrete(3)})))}), BOX),
    "asymmetric": (BOX, spaces.Box(np.array([-1, 0, 5], np.float32), np.array([1, 10, 6], np.float32))),
    "huge": (BOX, spaces.Box(-3e38, 3e38, (1,), np.float32)),
    "bytes": (BOX, spaces.Box(0, 255, (2,), np.uint8)),
}
REFUSED = {
    "text": (spaces.Text(3), BOX, "observation space: expects Box, Discrete"),
    "sequence": (spaces.Sequence(spaces.Discrete(2)), BOX, "observation space: expects Box, Discrete"),
    "graph": (spaces.Graph(BOX, None), BOX, "observation space: expects Box, Discrete"),
    "text in dict": (spaces.Dict({"a": BOX, "b": spaces.Text(3)}), BOX, "observation space: expects Box, Discrete"),
    "empty": (spaces.Box(-1, 1, (0,)), BOX, "observation space: expects Box, Discrete"),
    "discrete actions": (BOX, spaces.Discrete(3), "action space: expects a Box with bounds, not Discrete(3)"),
    "multidiscrete actions": (BOX, spaces.MultiDiscrete([2, 2]), "action space: expects a Box with bounds, not Multi"),
    "dict actions": (BOX, spaces.Dict({"a": BOX}), "action space: expects a Box with bounds, not Dict"),
    "unbounded actions": (BOX, spaces.Box(-np.inf, np.inf, (2,)), "action space: expects a Box with bounds, not Box"),
    "half bounded actions": (BOX, spaces.Box(0, np.inf, (2,)), "action space: expects a Box with bounds, not Box"),
}


class Sampled(gymnasium.Env):
    """Random elements of an observation space; ends after five steps."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.steps += 1
        return self.observation_space.sample(), 1.0, self.steps == 5, False, {}


def make_sampled(name):
    return from_gymnasium(name, lambda: Sampled(*TRAINED[name]), max_episode_steps=9)


@pytest.mark.parametrize("name", TRAINED)
def test_every_space_is_played(name):
    env = make_sampled(name)
    timestep, step = env.reset(jax.random.key(0)), jax.jit(env.step)
    for key in jax.random.split(jax.random.key(1), 6):
        action = jax.random.uniform(key, (env.action_size,), minval=-1.2, maxval=1.2)
        timestep = step(timestep, action)
        assert timestep.obs.shape == (env.observation_size,) and np.isfinite(timestep.obs).all()
    assert env.host.error() is None and int(env.status(timestep)["unstable_steps"]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAINED)
def test_every_space_is_trained_on(name):
    env = make_sampled(name)
    _, state = trained(env, 50)
    assert env.host.error() is None and int(state.gradient_steps) == 50 and not state.agent.diverged.any()


@pytest.mark.parametrize("name", REFUSED)
def test_other_spaces_are_refused_in_one_line(name):
    observation, action, message = REFUSED[name]
    with pytest.raises(ValueError) as error:
        from_gymnasium(name, lambda: Sampled(observation, action), max_episode_steps=9)
    assert message in str(error.value) and "\n" not in str(error.value)


# Signals.


@pytest.mark.slow
@pytest.mark.parametrize("processes", [0, 2])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_signal_to_the_whole_job_loses_nothing_and_leaves_no_process(tmp_path, number, processes):
    paths = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parent.parent)])
    command = [sys.executable, "-m", "experiments.run", *TINY, f"--env={COUNTER}", "--env_args=seconds=0.01"]
    command += [f"--env_processes={processes}", "--name=a", "--steps=100000"]
    environment = os.environ | {"PYTHONPATH": paths}
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
    ) as process:
        checkpoint = tmp_path / "runs/gym-host_tasks-Counter-v0/td3_sqt/a/checkpoint"
        deadline = time.monotonic() + 200
        while not [*checkpoint.glob("step_*[0-9]")] and time.monotonic() < deadline:
            time.sleep(0.1)
        os.killpg(process.pid, number)
        printed = process.communicate(timeout=100)[0].decode()
    assert process.returncode == (-9 if number == signal.SIGKILL else 130), printed
    deadline = time.monotonic() + 20
    while group_exists(process.pid) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not group_exists(process.pid)
    again = [*command[:3], f"--resume={checkpoint.parent}", f"--env={COUNTER}"]
    with subprocess.Popen(
        again, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, start_new_session=True
    ) as resumed:
        line = resumed.stdout.readline() + resumed.stdout.readline()
        resumed.terminate()
        resumed.communicate(timeout=100)
    assert b"resuming at step" in line


def group_exists(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True
