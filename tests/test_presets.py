"""Presets are valid for all algorithms and tasks."""

import algorithm_rows
import jax
import pytest
from probe_envs import constant_reward

from experiments.commandline.presets import PRESETS, PresetRow, preset_settings
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.config import ConfigError
from sqt_jax.experiment import make_config, make_train

NINE = [algo for algo in ALGORITHMS if algo.startswith(("td3", "sac", "td7"))]
NOT_RELEASED = [algo for algo in ALGORITHMS if algo not in NINE]


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_a_configuration_for_every_algorithm_and_environment(preset):
    for algo in NINE if preset == "released" else ALGORITHMS:
        for env in ("cheetah", "humanoid-v5"):
            settings = preset_settings(preset, algo, env)
            flat = make_config(algo, env, **settings).flat()
            assert {name: flat[name] for name in settings} == settings


@algorithm_rows.every(NINE, fast=("sac_sqt", "td7_sqt_tuple"))
def test_the_released_preset_makes_a_complete_run(algo):
    """Traced, not compiled; the updates themselves: test_golden."""
    tiny = {"hidden": (5, 4), "embedding_size": 6, "steps": 1000, "warmup_steps": 300, "eval_every": 500}
    config = make_config(algo, "ant", **preset_settings("released", algo, "ant") | tiny)
    train = make_train(config, constant_reward())
    state, history = jax.eval_shape(jax.vmap(train), jax.random.split(jax.random.key(0), 3))
    assert history.returns.shape == (3, 3, 10)
    assert {"critic_loss", "actor_loss", "q_std"} <= history.metrics.keys()
    assert ("encoder_loss" in history.metrics) == ("assessments" in history.metrics) == algo.startswith("td7")
    assert ("entropy" in history.metrics) == algo.startswith("sac")
    assert "log_std" in getattr(state.agent, "learner", state.agent).actor["params"]
    assert config.train.updates_per_step == (2 if algo.startswith("td7") else 1)
    assert config.agent.policy_delay == 2 and config.agent.actor_reduce == "mean"
    assert config.agent.penalty_coef == (1 if "_sqt" in algo else 0)


@pytest.mark.parametrize("algo", NOT_RELEASED)
def test_the_released_preset_rejects_the_other_rows(algo):
    with pytest.raises(ConfigError, match=f"--preset: released has no settings for {algo} on ant"):
        preset_settings("released", algo, "ant")


def test_paper_changes_nothing_and_quick_is_shorter():
    assert preset_settings("paper", "sac_sqt", "ant") == {}
    assert preset_settings("quick", "sac_sqt", "ant")["steps"] < 50_000


def test_later_rows_override_earlier_ones_if_they_are_for_the_algorithm(monkeypatch):
    rows = (
        PresetRow({"steps": 1, "lr": 0.1}),
        PresetRow({"steps": 2}, ("td3", "td7")),
        PresetRow({"lr": 0.3}, penalty=True),
    )
    monkeypatch.setitem(PRESETS, "layers", rows)
    assert preset_settings("layers", "sac", "walker") == {"steps": 1, "lr": 0.1}
    assert preset_settings("layers", "td3_sqt", "walker") == {"steps": 2, "lr": 0.3}
    assert preset_settings("layers", "td3", "ant") == {"steps": 2, "lr": 0.1}
    # A row under a name of its own: rows decide, not names.
    monkeypatch.setitem(ALGORITHMS, "careful", ALGORITHMS["td3_sqt"])
    assert preset_settings("layers", "careful", "ant") == {"steps": 2, "lr": 0.3}
