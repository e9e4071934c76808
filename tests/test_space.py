"""`--space`: forms, limits, the settings that an algorithm has, the values of a grid."""

import pytest

from experiments.commandline.arguments import UsageError
from experiments.tuning.space import Axis, axes_of, check_no_flags, grid_size, parse_space


def test_every_form_is_parsed():
    axes = parse_space("penalty_coef=0..1, lr=log:1e-4..1e-3,gamma=0.9..0.99:0.03,tau=0.01|0.005", "td3_sqt")
    assert axes == (
        Axis("penalty_coef", 0.0, 1.0),
        Axis("lr", 1e-4, 1e-3, log=True),
        Axis("gamma", 0.9, 0.99, step=0.03),
        Axis("tau", 0.005, 0.01, choices=(0.01, 0.005)),
    )
    assert parse_space(",".join(map(str, axes)), "td3_sqt") == axes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "--space: expects NAME=LOW..HIGH, NAME=log:LOW..HIGH, NAME=LOW..HIGH:STEP or NAME=A|B|C, separated by"),
        ("lr", "--space: expects NAME=LOW..HIGH, "),
        ("lr=0..1,", "--space: expects NAME=LOW..HIGH, "),
        ("lr=0..1,lr=0..1", "--space: expects lr once"),
        ("actor_lr=0..1", "--space: expects one of penalty_coef, lr, gamma, tau, temperature, not 'actor_lr'"),
        ("batch_size=1..2", "--space: expects one of penalty_coef, lr, gamma, tau, temperature, not 'batch_size'"),
        ("temperature=0..1", "--space: temperature has no effect with td3_sqt"),
        ("lr=0..", "--space: lr expects numbers as in NAME=LOW..HIGH"),
        ("lr=a..b", "--space: lr expects numbers as in"),
        ("lr=0..inf", "--space: lr expects numbers as in"),
        ("lr=0..nan", "--space: lr expects numbers as in"),
        ("lr=0..2", "--space: lr expects a number from 0 to 1, not 2.0"),
        ("penalty_coef=-1..1", "--space: penalty_coef expects a number of at least 0, not -1.0"),
        ("lr=1..0", "--space: lr expects LOW below HIGH, not 1..0"),
        ("lr=0.5..0.5", "--space: lr expects LOW below HIGH"),
        ("lr=log:0..1", "--space: lr expects log:LOW..HIGH with LOW above 0 and no STEP, not log:0..1"),
        ("lr=log:0.1..1:0.1", "--space: lr expects log:LOW..HIGH with LOW above 0 and no STEP"),
        ("lr=0..1:0.3", "--space: lr expects whole STEPs from LOW to HIGH, at most 10,000, not 0..1:0.3"),
        ("lr=0..1:0", "--space: lr expects whole STEPs"),
        ("lr=0..1:-0.1", "--space: lr expects whole STEPs"),
        ("lr=0..1:2", "--space: lr expects whole STEPs"),
        ("lr=0..1:1e-9", "--space: lr expects whole STEPs"),
        ("lr=0..1:", "--space: lr expects numbers as in"),
        ("lr=0.1", "--space: lr expects NAME=LOW..HIGH, "),
        ("lr=0.1|0.1", "--space: lr expects NAME=LOW..HIGH, "),
        ("lr=0.1|2", "--space: lr expects a number from 0 to 1, not 2.0"),
        ("lr=0.1|", "--space: lr expects numbers as in"),
    ],
)
def test_other_texts_are_rejected_in_one_line(text, message):
    with pytest.raises(UsageError) as error:
        parse_space(text, "td3_sqt")
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


def test_values_of_a_range_with_a_step_are_those_that_were_meant():
    (axis,) = parse_space("penalty_coef=0..1:0.1", "sac_sqt")
    assert axis.values == (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


def test_a_grid_is_finite_if_all_its_axes_are():
    assert grid_size(parse_space("penalty_coef=0..1:0.1,lr=0.1|0.2|0.3", "td3_sqt")) == 33
    assert grid_size(parse_space("penalty_coef=0..1:0.1,lr=0..1", "td3_sqt")) is None


def test_a_baseline_has_the_axes_without_the_penalty():
    axes = parse_space("penalty_coef=0..1,lr=0..1", "sac_sqt")
    assert [axis.name for axis in axes_of("sac", axes)] == ["lr"]
    assert axes_of("sac_sqt", axes) == axes


@pytest.mark.parametrize("given", ["penalty_coef", "learn_temperature"])
def test_a_tuned_setting_is_no_flag_of_the_runs(given):
    axes = parse_space("penalty_coef=0..1,temperature=0..1", "sac_sqt")
    check_no_flags(axes, ["lr"])
    with pytest.raises(UsageError, match="^--(penalty_coef|temperature): has no effect where --space tunes it$"):
        check_no_flags(axes, [given])
