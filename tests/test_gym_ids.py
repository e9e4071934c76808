"""Environments of Gymnasium by name."""

import functools
import sys

import gymnasium
import jax
import jax.numpy as jnp
import pytest
from gymnasium.wrappers import TimeLimit
from host_tasks import Counter

from sqt_jax import envs
from sqt_jax.envs import gym_ids
from sqt_jax.envs.gym_ids import from_gymnasium, make_gym
from sqt_jax.train import TrainState

CIRCLE: list = []
CIRCLE.append(CIRCLE)


def test_an_environment_by_its_id():
    env = envs.make("gym:Pendulum-v1")
    assert (env.name, env.observation_size, env.action_size, env.episode_length) == ("gym:Pendulum-v1", 3, 1, 200)
    assert env.version == f"gymnasium {gymnasium.__version__}" and env.host


def test_the_module_in_a_name_is_imported_and_registers(tmp_path, monkeypatch):
    (tmp_path / "registers_of_a_test.py").write_text(
        "import gymnasium\ngymnasium.register('OfATest-v0', 'host_tasks:Counter', max_episode_steps=7)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    env = make_gym("gym:registers_of_a_test:OfATest-v0")
    assert env.episode_length == 7 and env.version == ""  # of no installed package
    assert gym_ids.module_of(env.name) == "registers_of_a_test" and gym_ids.module_of("gym:a/B-v0") is None


def test_a_name_alone_imports_nothing():
    assert envs.resolve("gym:no_such_module:Thing-v0") == "gym:no_such_module:Thing-v0"
    assert envs.physics_of("gym:no_such_module:Thing-v0") == ("gymnasium",)
    assert "no_such_module" not in sys.modules


def test_arguments_and_the_time_limit_reach_the_environment():
    env = make_gym("gym:host_tasks:Counter-v0", {"bad_above": 0.25}, max_episode_steps=9)
    made = env.host.make()
    assert made.unwrapped.bad_above == 0.25 and made.spec.max_episode_steps == env.episode_length == 9
    assert env.host.make(render_mode="rgb_array").render_mode == "rgb_array"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gym:Pendulum", "No registered env with id: Pendulum; did you mean gym:Pendulum-v1?"),
        ("gym:Pendulum-v9", "Environment version `v9` for environment `Pendulum` doesn't exist"),
        ("gym:no_such_module:Thing-v0", "ModuleNotFoundError: No module named 'no_such_module'"),
        (
            "gym:host_tasks:Endless-v0",
            "has no time limit, so that an evaluation might not end; add --max_episode_steps",
        ),
        ("gym:CartPole-v1", "action space: expects a Box with bounds, not Discrete"),
        ("gym:phys2d/Pendulum-v0", "computes with JAX, which would wait for itself inside our program; add --env_pro"),
        ("gym:", "expects gym:ID or gym:MODULE:ID, as in gym:Pendulum-v1, not 'gym:'"),
        ("gym:a b-v0", "expects gym:ID or gym:MODULE:ID"),
        ("gym:../x:A-v0", "expects gym:ID or gym:MODULE:ID"),
    ],
)
def test_what_cannot_be_made_is_an_error_in_one_line(name, message):
    with pytest.raises(ValueError) as error:
        envs.make(name)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_an_environment_with_jax_can_be_played_by_hand():
    assert envs.make("gym:phys2d/Pendulum-v0", in_program=False).host.make().action_space.shape == (1,)


@pytest.mark.parametrize(
    ("kept", "holds"),
    [
        ({0: 1, "a": 2, None: 3}, False),  # keys that cannot be sorted
        ({0: 1, "a": [{"b": (jnp.zeros(1),)}]}, True),
        (TrainState(*range(len(TrainState._fields)))._replace(replay=jnp.zeros(1)), True),
        (CIRCLE, False),
    ],
)
def test_jax_is_found_in_whatever_an_environment_keeps(kept, holds):
    env = Counter()
    env.kept = kept
    assert gym_ids.uses_jax(env) == holds


@pytest.mark.parametrize("max_episode_steps", [0, 9])
def test_a_wrapper_that_hides_the_end_of_episodes_does_not_make_them_endless(max_episode_steps):
    class Hiding(gymnasium.Wrapper):
        def step(self, action):
            obs, reward, terminated, _, info = self.env.step(action)
            return obs, reward, terminated, False, info

    env = from_gymnasium("hiding", lambda: Hiding(TimeLimit(Counter(), 3)), max_episode_steps)
    timestep, truncated = env.reset(jax.random.key(0)), []
    for _ in range(6):
        timestep = env.step(timestep, jnp.zeros(3))
        truncated.append(bool(timestep.truncated))
    assert env.episode_length == 3 and truncated == [False, False, True] * 2


def test_arguments_of_gymnasium_itself():
    env = make_gym("gym:host_tasks:Counter-v0", {"disable_env_checker": False, "max_episode_steps": 4})
    assert env.episode_length == 4
    with pytest.raises(ValueError, match="env_args: expects no max_episode_steps with --max_episode_steps, which sets"):
        make_gym("gym:host_tasks:Counter-v0", {"max_episode_steps": 4}, max_episode_steps=5)


def test_unknown_arguments_are_named():
    with pytest.raises(ValueError, match="unexpected keyword argument 'wings'"):
        make_gym("gym:Pendulum-v1", {"wings": 2})


def test_the_time_limit_of_wrapped_environments():
    assert gym_ids.time_limit(Counter()) is None
    assert gym_ids.time_limit(gymnasium.wrappers.OrderEnforcing(TimeLimit(Counter(), 12))) == 12
    assert from_gymnasium("counter", Counter, max_episode_steps=8).episode_length == 8
    assert from_gymnasium("counter", functools.partial(gym_ids.limited, Counter, 6), 8).episode_length == 6
