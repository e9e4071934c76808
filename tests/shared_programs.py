"""Runs of one process that share their compiled functions: a run's settings are all that these depend on."""

import functools

import pytest

import experiments.run
from sqt_jax.algorithms import make_trainer
from sqt_jax.train import make_sweep


@pytest.fixture(scope="module", autouse=True)
def shared_programs():
    """For modules that start many runs in their process, by importing it: most of such a run is tracing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiments.run, "make_trainer", functools.cache(make_trainer))
        patch.setattr(experiments.run, "make_sweep", functools.cache(make_sweep))
        yield
