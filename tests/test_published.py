"""The published numbers that are stored with the package."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from experiments.evidence import published

ROOT = Path(__file__).parent.parent


def figures(algo, env, source):
    return [f for f in published.scores() if (f.algo, f.env) == (algo, env) and source in f.source]


def test_figures_have_their_environment_version_and_source():
    (figure,) = figures("td3", "cheetah", "TD3 paper")
    assert (figure.value, figure.std, figure.seeds, figure.env_version) == (9637, None, "10", "v1")
    (figure,) = figures("td7_sqt", "humanoid", "released")
    assert (figure.value, figure.std, figure.env_version, figure.updates_per_step) == (8144.7, 354.1, "Gym v2", "2")
    (figure,) = figures("sac_sqt", "humanoid", "SQT paper")
    assert (figure.value, figure.env_version) == (5700, "version not stated")
    for figure in published.scores():
        assert figure.source and figure.env_version and np.isfinite(figure.value)


@pytest.mark.parametrize(("env", "notes"), [("cheetah", 0), ("ant", 1), ("humanoid", 2)])
def test_the_figures_of_the_archive_have_its_faults_as_notes(env, notes):
    (figure,) = figures("td3", env, "released")
    assert len(figure.notes) == notes


def test_the_fault_of_the_papers_figure():
    (figure,) = figures("td3", "humanoid", "SQT paper")
    assert figure.notes == (published.NEVER_LEARNS,)
    seeds = json.loads((published.FOLDER / "released_2023_scores.json").read_text())["humanoid"]["td3"]["max_per_seed"]
    assert seeds[2] < 361
    assert figures("td3_sqt", "humanoid", "SQT paper")[0].notes == ()


def test_q_stds():
    assert {figure.algo: figure.value for figure in published.q_stds()} == {"td3": 0.93, "td3_sqt": 2.11}


def test_all_data_are_installed_with_the_package():
    folder = ROOT / "experiments" / "evidence"
    packaged = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    matched = {path for pattern in packaged["experiments.evidence"] for path in folder.glob(pattern)}
    assert matched == {path for path in (folder / "data").rglob("*") if path.is_file()}
    assert {*published.FOLDER.iterdir()} < matched
