"""The stored results: every run can be read and pooled, and the README's tables follow from the files."""

import re
from pathlib import Path

import numpy as np
import pytest

from experiments.evidence import statistics
from experiments.evidence.finished_runs import find, read_run
from experiments.evidence.published import FOLDER

RESULTS = Path(__file__).parent.parent / "experiments" / "results"
README = (RESULTS / "README.md").read_text()
RUNS = sorted(path.parent for path in RESULTS.glob("*/evaluations.csv"))
EVALUATION_EVERY = 5_000  # of the published curves


def returns(run: Path, steps: int) -> np.ndarray:
    """[seeds], the returns of a stored run at an evaluation."""
    return np.array([seed.columns["return_mean"][seed.columns["env_steps"] == steps].item() for seed in read_run(run)])


def published(task: str, steps: int) -> np.ndarray:
    """[seeds], of TD3's published curves."""
    with np.load(FOLDER / "td3_published_curves.npz") as curves:
        return curves[task][:, steps // EVALUATION_EVERY]


def rows_of(table: str) -> list[list[str]]:
    """The cells of a Markdown table, without the line below its header."""
    lines = [line for line in table.splitlines() if line.startswith("|") and not line.startswith("|---")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def text(values: np.ndarray) -> str:
    return f"{values.mean():,.0f} ± {values.std():,.0f}"


@pytest.mark.parametrize("run", RUNS, ids=lambda run: run.name)
def test_a_stored_run_can_be_read(run):
    assert [seed.seed for seed in read_run(run)][:5] == [0, 1, 2, 3, 4]
    assert f"| `{run.name}` |" in README


def test_every_stored_run_is_pooled():
    found, left_out = find([str(RESULTS)])
    assert sorted(found) == RUNS and not left_out


def test_the_comparison_with_the_published_curves():
    tables = re.findall(r"(\| return at steps .*?)\n\n", README, re.DOTALL)
    assert len(tables) == 2
    for table in tables:
        header, *rows = rows_of(table)
        steps = [int(cell.replace(",", "")) for cell in header[1:]]
        assert len(rows) >= 2
        for name, *cells in rows:
            run = RESULTS / name
            values = [returns(run, at) if run.is_dir() else published(name, at) for at in steps]
            assert cells == [text(value) for value in values], name


def test_the_scores():
    """The column `score` of the table of runs; runs of several coefficients have their range."""
    checked = 0
    header, *rows = rows_of(README.split("\nThe comparisons: ")[0])
    for name, *cells in rows:
        shown = cells[header.index("score") - 1]
        seeds = read_run(RESULTS / name.strip("`"))
        curves = np.stack([seed.columns["return_mean"] for seed in seeds]).reshape(-1, 5, len(seeds[0].columns["seed"]))
        scores = [statistics.score(group) for group in curves]  # a coefficient after the other
        if len(scores) == 1:
            assert shown == f"{scores[0].mean:,.0f} ± {scores[0].std:,.0f}", name
        else:
            assert shown == f"{min(s.mean for s in scores):,.0f} to {max(s.mean for s in scores):,.0f}", name
        checked += 1
    assert checked == len(RUNS)
