"""The soak command."""

import pytest
from absl import flags
from absl.testing import flagsaver

from experiments import soak
from experiments.endurance.many_steps import SoakFailure


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(soak.jax_settings, "prepare", lambda: None)
    soak.FLAGS.mark_as_parsed()
    with flagsaver.flagsaver(steps=200, envs=3, rounds=2):
        yield


def test_a_single_round_which_has_no_memory_to_compare_with_is_rejected(short):
    with pytest.raises(flags.IllegalFlagValueError, match="rounds"):
        soak.FLAGS.rounds = 1


def test_a_failure_is_the_last_line_and_exit_code_1(short, monkeypatch):
    def fails(tasks, *numbers):
        assert "humanoid" in tasks and numbers[:3] == (200, 3, 2)
        raise SoakFailure("memory grew")

    monkeypatch.setattr(soak, "run_soak", fails)
    with pytest.raises(SystemExit, match="^memory grew$"):
        soak.main(["soak"])
