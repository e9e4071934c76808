import pytest

from experiments.presets import PRESETS, Row, preset_settings
from sqt_jax.algorithms import ALGORITHMS, make_config
from sqt_jax.envs import TASKS


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_a_configuration_for_every_algorithm_and_environment(preset):
    for algo in ALGORITHMS:
        for env in TASKS:
            settings = preset_settings(preset, algo, env)
            flat = make_config(algo, env, **settings).flat()
            assert {name: flat[name] for name in settings} == settings


def test_paper_changes_nothing_and_quick_is_shorter():
    assert preset_settings("paper", "sac_sqt", "ant") == {}
    assert preset_settings("quick", "sac_sqt", "ant")["steps"] < 50_000


def test_later_rows_win_where_their_patterns_match(monkeypatch):
    rows = (Row({"steps": 1, "lr": 0.1}), Row({"steps": 2}, algo="td3*"), Row({"lr": 0.3}, env="ant"))
    monkeypatch.setitem(PRESETS, "layers", rows)
    assert preset_settings("layers", "sac", "walker") == {"steps": 1, "lr": 0.1}
    assert preset_settings("layers", "td3_sqt", "walker") == {"steps": 2, "lr": 0.1}
    assert preset_settings("layers", "td3", "ant") == {"steps": 2, "lr": 0.3}
