"""The soak test makes the steps that it reports, and fails if a number is not finite or the memory grows."""

import re
from types import SimpleNamespace

import jax.numpy as jnp
import psutil
import pytest

from experiments.endurance import many_steps
from experiments.endurance.many_steps import SoakFailure, run_soak
from sqt_jax import envs


def test_every_task_is_stepped_in_every_round():
    lines = []
    run_soak(("swimmer", "hopper"), 200, 3, 2, lines.append)
    assert [re.search(r", (\w+): 0 unstable steps", line)[1] for line in lines[:-1]] == ["swimmer", "hopper"] * 2
    assert int(lines[-2].split()[0].replace(",", "")) == 204  # 17 lockstep steps of 3, four times
    assert lines[-1].startswith("all numbers finite; memory grew by ")


def test_numbers_that_are_not_finite_end_it(monkeypatch):
    original = envs.make

    def broken(name, physics):
        env = original(name, physics)
        return env._replace(
            step=lambda timestep, action: env.step(timestep, action)._replace(reward=jnp.float32(jnp.nan))
        )

    monkeypatch.setattr(envs, "make", broken)
    with pytest.raises(SoakFailure, match="swimmer: the environment returned a number that is not finite"):
        run_soak(("swimmer",), 200, 3, 2, print)


def test_memory_that_grows_ends_it(monkeypatch):
    sizes = iter(range(0, 10_000, many_steps.GROWTH_MIB))
    process = SimpleNamespace(memory_info=lambda: SimpleNamespace(rss=next(sizes) * 2**20))
    monkeypatch.setattr(psutil, "Process", lambda: process)
    with pytest.raises(SoakFailure, match="memory grew by 128 MiB"):
        run_soak(("swimmer",), 200, 3, 2, print)
