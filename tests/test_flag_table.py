"""Every setting is a flag, with help, its default and a group."""

import dataclasses
import re

from experiments.commandline import flag_table
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.config import SALE_SETTINGS, TD7_SETTINGS, AgentConfig, TrainConfig


def test_every_setting_is_a_flag_with_help_and_its_default():
    text = flag_table.help_text()
    rows = {flag.name: flag for group in flag_table.FLAGS.values() for flag in group}
    for field in [*dataclasses.fields(AgentConfig), *dataclasses.fields(TrainConfig)]:
        if field.name in flag_table.NOT_FLAGS:
            continue
        assert rows[field.name].help, f"SETTING_HELP has no line for {field.name}"
        assert f"--{field.name}" in text
    assert "--steps=N " in text and "(1000000)" in text
    assert max(map(len, text.splitlines())) <= 120


def test_defaults_that_differ_between_algorithms_are_told():
    default = {
        field.name: field.default for config in (AgentConfig, TrainConfig) for field in dataclasses.fields(config)
    }
    rows = {algo: {**row.settings, **row.training} for algo, row in ALGORITHMS.items()}
    varied = {name for row in rows.values() for name, value in row.items() if value != default[name]}
    assert varied - set(flag_table.NOT_FLAGS) == set(flag_table.DEFAULT_TEXT)
    for name, text in flag_table.DEFAULT_TEXT.items():
        values = {
            row.get(name, default[name]) for algo, row in rows.items() if name != "penalty_coef" or "_sqt" in algo
        }
        assert all(str(value) in re.split(r"[ ;,]+", text) for value in values), name


def test_every_algorithm_is_named_in_the_help():
    text = next(flag.help for flag in flag_table.FLAGS["What to run"] if flag.name == "algo")
    for algo in ALGORITHMS:
        assert re.search(rf"\b{algo.split('_sqt')[0]}\b", text)


def test_td7s_settings_have_groups_of_their_own():
    assert {flag.name for flag in flag_table.FLAGS["TD7"]} == set(TD7_SETTINGS)
    assert {flag.name for flag in flag_table.FLAGS["SALE networks (TD7; --networks=sale)"]} == set(SALE_SETTINGS)
    names = [flag.name for group in flag_table.FLAGS.values() for flag in group]
    assert len(names) == len(set(names))
