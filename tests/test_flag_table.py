"""Every setting is a flag, with help, its default and a group."""

import re

import pytest
from algorithm_rows import has_effect

from experiments.commandline import flag_table
from sqt_jax.algorithms import ALGORITHMS, default_agent_config
from sqt_jax.config import FEATURES, SETTINGS
from sqt_jax.settings import settings_of

ROWS = {flag.name: flag for group in flag_table.FLAGS.values() for flag in group}


def test_every_setting_is_a_flag_with_help_and_its_default():
    text = flag_table.help_text()
    for name, about in (SETTINGS | settings_of(flag_table.OutputConfig)).items():
        assert (name in ROWS) == (about.flag == name)
        if name in ROWS:
            assert about.help in ROWS[name].help and f"--{name}" in text
            assert ROWS[name].default, name
    assert "--steps=N " in text and "(1000000)" in text
    assert max(map(len, text.splitlines())) <= 120
    assert "object at" not in text and "MISSING" not in text


def test_a_setting_without_a_flag_is_set_by_the_algorithm_or_by_another_flag():
    assert {name: about.flag for name, about in SETTINGS.items() if about.flag != name} == {
        "penalty": None,
        "learn_temperature": "temperature",
    }


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_defaults_are_shown_as_the_algorithms_rows_have_them(algo):
    config, training = default_agent_config(algo), ALGORITHMS[algo].training
    for name, flag in ROWS.items():
        if name not in SETTINGS or SETTINGS[name].default_text or not has_effect(algo, name):
            continue
        value = getattr(config, name, training.get(name, SETTINGS[name].default))
        text = str(value).lower() if isinstance(value, bool) else str(value)
        if isinstance(value, tuple):
            text = ",".join(map(str, value))
        shown = dict(re.findall(r"(\S+) for ([^;]+)", flag.default))
        own = [default for default, names in shown.items() if _names(algo) & set(names.split(", "))]
        assert (own or [re.split(r";| for ", flag.default)[0]]) == [text], (algo, name, flag.default)


def _names(algo):
    """The names that a default's text may use for an algorithm: its name, its baseline, its ending."""
    baseline = ALGORITHMS[algo].baseline or algo
    return {algo, baseline, algo.removeprefix(baseline)}


def test_settings_that_may_be_swept_are_marked():
    marked = {name for name, flag in ROWS.items() if "may be swept" in flag.help}
    assert marked == {name for name, about in SETTINGS.items() if about.swept}


def test_every_algorithm_is_named_in_the_help():
    for algo in ALGORITHMS:
        assert re.search(rf"\b{algo}\b", ROWS["algo"].help)


def test_every_feature_has_a_group_and_no_flag_has_two():
    for feature, title in FEATURES.items():
        group = flag_table.FLAGS[f"With {title}"]
        assert group and all(SETTINGS[flag.name].features[0] == feature for flag in group)
    names = [flag.name for group in flag_table.FLAGS.values() for flag in group]
    assert len(names) == len(set(names))
