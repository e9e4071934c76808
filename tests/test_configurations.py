"""Configurations of a command line, without a look at the machine."""

import jax
import pytest

from experiments.commandline import flags
from experiments.commandline.arguments import UsageError
from experiments.running.configurations import configs_of


def parsed(*words):
    return flags.parse(["run", "--algo=td3_sqt", "--env=ant", *words])


def test_there_is_one_for_each_combination_of_swept_values(monkeypatch):
    monkeypatch.setattr(jax, "local_devices", pytest.fail)
    configs = configs_of(parsed("--penalty_coef=0.1,0.5", "--lr=1e-3,1e-4", "--preset=quick"))
    assert [(config.agent.penalty_coef, config.agent.lr) for config in configs] == [
        *((0.1, 1e-3), (0.1, 1e-4), (0.5, 1e-3), (0.5, 1e-4))
    ]
    assert {config.train.steps for config in configs} == {6_000}  # of the preset


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--temperature=0.1"], "--temperature: has no effect with td3_sqt"),
        (["--preset=quick", "--warmup_steps=6000"], "--warmup_steps: expects fewer than the run's steps (6000)"),
    ],
)
def test_settings_that_do_not_fit_are_rejected(words, line):
    with pytest.raises(UsageError) as error:
        configs_of(parsed(*words))
    assert str(error.value).startswith(line)
