"""The soak makes the steps that it says, and notices numbers that are not finite."""

import re

import jax.numpy as jnp
import pytest
from absl import flags
from absl.testing import flagsaver

from experiments import soak
from sqt_jax import envs


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(soak.runtime, "prepare", lambda: None)
    monkeypatch.setattr(soak, "TASKS", ("swimmer", "hopper"))
    soak.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(steps=200, envs=3, rounds=2):
        yield


def test_a_single_round_which_has_no_memory_to_compare_with_is_refused(short):
    with pytest.raises(flags.IllegalFlagValueError, match="rounds"):
        soak.FLAGS.rounds = 1


def test_every_task_has_its_turns(short, capsys):
    soak.main(["soak"])
    lines = capsys.readouterr().out.splitlines()
    assert [re.search(r", (\w+): 0 unstable steps", line)[1] for line in lines[:-1]] == ["swimmer", "hopper"] * 2
    assert int(lines[-2].split()[0].replace(",", "")) == 204  # 17 lockstep steps of 3, four times
    assert lines[-1].startswith("all numbers finite; memory grew by ")


def test_numbers_that_are_not_finite_end_it(short, monkeypatch):
    original = envs.make

    def broken(name, physics):
        env = original(name, physics)
        return env._replace(
            step=lambda timestep, action: env.step(timestep, action)._replace(reward=jnp.float32(jnp.nan))
        )

    monkeypatch.setattr(soak.envs, "make", broken)
    with pytest.raises(SystemExit, match="swimmer: a number that is not finite"):
        soak.main(["soak"])
