"""Scores, IQM, improvements and bootstrap intervals, by hand and by their laws."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import experiments
from experiments.evidence.statistics import (
    bootstrap,
    exceeds,
    improvement,
    iqm,
    mean,
    probability_of_improvement,
    score,
)

REFERENCE = Path(experiments.__file__).parent / "evidence" / "data" / "reference"
FINITE = st.floats(-1e4, 1e4, allow_subnormal=False)
SEEDS = hnp.arrays(float, st.integers(1, 12), elements=FINITE)


@pytest.mark.parametrize(
    ("task", "expected_mean", "std"),
    [("HalfCheetah", 9636.95, 859.06), ("Walker", 4682.82, 539.64), ("Ant", 4372.44, 1000.33)],
)
def test_score_reproduces_td3s_published_table(task, expected_mean, std):
    curves = np.load(REFERENCE / "td3_published_curves.npz")[task]
    result = score(curves)
    assert (round(result.mean, 2), round(result.std, 2)) == (expected_mean, std)


def test_score_by_hand():
    # Means 2, 5, 4: the second evaluation, where the seeds are 3 and 7.
    assert score(np.array([[1.0, 3.0, 8.0], [3.0, 7.0, 0.0]])) == (5.0, 2.0, 1)
    assert score(np.array([[1.0, np.nan, 2.0], [1.0, 9.0, 4.0]])) == (3.0, 1.0, 2)
    assert score(np.full((2, 3), np.nan)) is None


def test_iqm_by_hand():
    assert iqm(np.array([0.0, 1, 2, 3, 4, 5, 6, 1000])) == np.mean([2, 3, 4, 5])
    assert iqm(np.array([7.0, 1, 2, 3, 100])) == 4.0  # five seeds: one is left out at each end
    assert iqm(np.array([1.0, 2, 6])) == 3.0  # fewer than four: the mean
    assert iqm(np.array([0.0, 9.0]), np.array([1.0, 2.0])) == 1.5  # of two strata together
    assert np.isnan(iqm(np.array([1.0, 2, 3, np.nan])))  # not left out as if it were large


@given(SEEDS, st.floats(-100, 100), st.floats(0.01, 100), st.randoms(use_true_random=False))
def test_iqm_shifts_and_scales_with_the_values_and_ignores_their_order(values, shift, scale, random):
    tolerance = {"rtol": 1e-9, "atol": 1e-6}
    np.testing.assert_allclose(iqm(values + shift), iqm(values) + shift, **tolerance)
    np.testing.assert_allclose(iqm(values * scale), iqm(values) * scale, **tolerance)
    np.testing.assert_allclose(iqm(-values), -iqm(values), **tolerance)
    order = random.sample(range(len(values)), len(values))
    assert iqm(values[order]) == iqm(values)
    assert values.min() - 1e-9 <= iqm(values) <= values.max() + 1e-9


def test_probability_of_improvement_by_hand():
    x, y = np.array([1.0, 3.0]), np.array([1.0, 2.0])
    # 1 > 1 is a tie, 1 > 2 is not, 3 > 1 and 3 > 2 are.
    assert probability_of_improvement(x, y) == (0.5 + 0 + 1 + 1) / 4
    # A second task, where x always wins, weighs the same although it has one seed.
    assert probability_of_improvement(x, y, np.array([5.0]), np.array([4.0])) == (0.625 + 1) / 2


@given(SEEDS, SEEDS)
def test_probability_of_improvement_against_itself_is_one_half(x, y):
    assert probability_of_improvement(x, x) == 0.5
    np.testing.assert_allclose(probability_of_improvement(x, y) + probability_of_improvement(y, x), 1.0)
    np.testing.assert_allclose(probability_of_improvement(2 * x, 2 * y), probability_of_improvement(x, y))


def test_improvement_by_hand():
    # 12 is 20 % above 10, 3 is 25 % below 4: -2.5 % over the two tasks.
    assert improvement(np.array([11.0, 13.0]), np.array([10.0])) == pytest.approx(20)
    tasks = (np.array([11.0, 13.0]), np.array([10.0]), np.array([3.0]), np.array([4.0]))
    assert improvement(*tasks) == pytest.approx(-2.5)
    assert np.isnan(improvement(np.array([1.0]), np.array([-1.0])))


def test_profile_by_hand():
    profile = mean(exceeds(np.array([0.2, 0.8]), np.array([0.0, 0.2, 0.5, 1.0])))
    np.testing.assert_array_equal(profile, [1.0, 0.5, 0.5, 0.0])  # a score is not above itself


@given(SEEDS)
def test_a_profile_falls_from_one_to_zero(values):
    thresholds = np.linspace(values.min() - 1, values.max(), 20)
    profile = mean(exceeds(values, thresholds))
    assert profile[0] == 1.0 and profile[-1] == 0.0 and (np.diff(profile) <= 0).all()


@given(hnp.arrays(float, st.integers(2, 12), elements=FINITE), st.sampled_from([mean, iqm]))
def test_an_interval_contains_the_estimate_and_is_within_the_values(values, statistic):
    low, high = bootstrap(statistic, values, resamples=500)
    slack = 1e-9 * (1 + np.abs(values).max())
    assert values.min() - slack <= low <= statistic(values) + slack
    assert statistic(values) - slack <= high <= values.max() + slack


def test_an_interval_of_many_normal_values_is_the_textbooks():
    values = np.random.default_rng(1).normal(10, 2, size=400)
    low, high = bootstrap(mean, values)
    half = 1.96 * values.std() / np.sqrt(400)
    assert low == pytest.approx(values.mean() - half, abs=0.02) and high == pytest.approx(
        values.mean() + half, abs=0.02
    )


def test_an_interval_is_repeatable_and_depends_on_the_confidence():
    values = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    assert bootstrap(iqm, values) == bootstrap(iqm, values)
    wide, narrow = bootstrap(mean, values), bootstrap(mean, values, confidence=0.5)
    assert wide.low < narrow.low < narrow.high < wide.high
    assert bootstrap(mean, np.array([3.0])) == (3.0, 3.0)


def test_strata_are_resampled_separately_and_leading_axes_together():
    # A constant stratum stays, whatever the other one draws.
    low, high = bootstrap(mean, np.array([0.0, 10.0]), np.full(3, 4.0))
    assert (low, high) == (2.0, 7.0)
    # Two evaluations of the same seeds: the second is the first one, doubled, in every draw.
    low, high = bootstrap(mean, np.array([[1.0, 2.0, 5.0], [2.0, 4.0, 10.0]]))
    np.testing.assert_allclose([low[1], high[1]], [2 * low[0], 2 * high[0]])


def test_an_interval_of_a_difference_covers_as_often_as_it_says():
    generator = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        low, high = bootstrap(mean, generator.normal(size=30), resamples=400)
        covered += low <= 0 <= high
    assert 0.88 <= covered / 200 <= 0.99
