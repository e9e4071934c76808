"""Grids of one's own: settings and their values."""

from pathlib import Path

import pytest

from experiments.commandline.arguments import UsageError
from experiments.grids.grid import make_cells
from experiments.grids.own_grid import check_not_set, parse_variants, setting_of


def test_a_grid_of_ones_own_is_all_combinations():
    assert parse_variants("penalty_coef=0.1,0.5; ensemble_size=2,5") == (
        ("--penalty_coef=0.1", "--ensemble_size=2"),
        ("--penalty_coef=0.1", "--ensemble_size=5"),
        ("--penalty_coef=0.5", "--ensemble_size=2"),
        ("--penalty_coef=0.5", "--ensemble_size=5"),
    )
    assert parse_variants("hidden=64,64|256,256") == (("--hidden=64,64",), ("--hidden=256,256",))
    assert parse_variants("") == ((),)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("penalty_coef=", "expects settings like"),
        ("=1", "expects settings like"),
        ("penalty_coef=1;lr", "expects settings like .*, not 'lr'"),
        ("penalty_coef=1,1", "expects each value of penalty_coef once"),
        ("lr=1;lr=2", "expects each setting once"),
        ("name=a,b", "expects settings of a run, not name"),
        ("help=true", "expects settings of a run, not help"),
        ("tuned=a,b", "expects settings of a run, not tuned"),
        ("penalty_coeff=1", "^--penalty_coeff: unknown flag; did you mean --penalty_coef"),
        ("penalty_coef=x", "^--penalty_coef=x: expects a number"),
    ],
)
def test_a_wrong_grid_of_ones_own_is_rejected(text, why):
    with pytest.raises(UsageError, match=why):
        make_cells(text, ["td3_sqt"], ["ant"], Path("runs"), [])


@pytest.mark.parametrize(
    ("grid", "word"),
    [
        ("penalty_coef=0.1,0.5", "--penalty_coef=0.9"),
        ("seeds=0,1|2,3", "--seeds=5"),
        ("penalty_inside_gamma=true,false", "--nopenalty_inside_gamma"),
        ("alpha", "--penalty_coef=0.5"),
    ],
)
def test_a_flag_of_every_run_does_not_set_what_the_grid_varies(grid, word):
    setting = word.lstrip("-").removeprefix("no").partition("=")[0]
    with pytest.raises(UsageError) as error:
        make_cells(grid, ["td3_sqt"], ["ant"], Path("runs"), ["--lr=1e-4", word])
    assert str(error.value) == f"{word}: expects settings that --grid={grid} does not vary, not {setting}"
    check_not_set(parse_variants("penalty_coef=1"), ["--config=file.yaml", "--normalize_observations"], "")


def test_the_setting_of_a_flag():
    words = ("--lr=1", "--nolayer_norm", "--layer_norm", "--normalize_observations", "--nowandb")
    assert [setting_of(word) for word in words] == ["lr", "layer_norm", "layer_norm", "normalize_observations", "wandb"]
