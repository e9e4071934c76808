"""Environments by `module:function`."""

import pytest

from sqt_jax.envs import factories

MODULE = """
import sys
import jax.numpy as jnp
import sqt_jax

def make():
    return sqt_jax.make_environment("flat", 1, 1, 10, lambda key: (jnp.zeros(1),) * 2, lambda x, a: (x, x, 0.0, False))

def fail():
    raise RuntimeError("no\\nsimulator")

def gym_env(**arguments):
    from host_tasks import Counter

    return Counter(**arguments)

def leave():
    sys.exit(0)

def cannot_close():
    import gymnasium

    class Stuck(gymnasium.Env):
        def close(self):
            raise RuntimeError("in use")

    return Stuck()

def number():
    return 5

value = 3
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "tasks_of_a_test.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    return "tasks_of_a_test"


def test_the_function_of_a_module_is_called(module):
    assert factories.make_from(f"{module}:make").name == "flat"


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("gym_env", "has no time limit, so that an evaluation might not end; add --max_episode_steps=N"),
        ("fail", "RuntimeError: no simulator (tasks_of_a_test.py, line 10)"),
        ("leave", "SystemExit: 0 (tasks_of_a_test.py, line 18)"),
        ("cannot_close", "RuntimeError: in use (tasks_of_a_test.py, line 25)"),
        (
            "number",
            "expects a function that returns an Environment (sqt_jax.make_environment) or a gymnasium.Env, not a int",
        ),
        ("value", "TypeError: 'int' object is not callable"),
        ("none", "AttributeError: module 'tasks_of_a_test' has no attribute 'none'"),
    ],
)
def test_what_is_no_environment_is_an_error_in_one_line(module, function, message):
    with pytest.raises(ValueError) as error:
        factories.make_from(f"{module}:{function}")
    assert str(error.value) == message


def test_a_gymnasium_environment_is_played_on_the_host(module):
    env = factories.make_from(f"{module}:gym_env", {"bad_above": 0.5}, max_episode_steps=6)
    assert env.name == f"{module}:gym_env" and env.episode_length == 6 and env.host
    assert env.host.make().unwrapped.bad_above == 0.5


def test_a_time_limit_is_for_gymnasium(module):
    with pytest.raises(ValueError, match="no effect with an Environment in JAX"):
        factories.make_from(f"{module}:make", max_episode_steps=6)


def test_a_module_that_does_not_exist():
    with pytest.raises(ValueError, match="^ModuleNotFoundError: No module named 'nowhere'$"):
        factories.make_from("nowhere.at_all:make")


@pytest.mark.parametrize(
    "name",
    [
        "ant",
        "brax:ant",
        "gym:Pendulum",
        "playground:CartpoleBalance",
        "a:",
        ":b",
        "a:b:c",
        "a.:b",
        "../a:b",
        "a b:c",
        "é:b",
        "a:b-1",
    ],
)
def test_other_names_are_no_functions(name):
    assert not factories.is_factory(name)
