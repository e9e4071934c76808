"""Proposals are a function of the trials before them; TPE finds the best of a made-up objective."""

import numpy as np
import pytest

optuna = pytest.importorskip("optuna", reason="needs the extra tune")
from optuna.trial import TrialState, create_trial  # noqa: E402

from experiments.tuning.proposals import distributions, make_sampler, propose  # noqa: E402
from experiments.tuning.space import parse_space  # noqa: E402

AXES = parse_space("penalty_coef=0..1,lr=log:1e-4..1e-3,tau=0.01|0.02,gamma=0.9..1:0.02", "td3_sqt")


def trials_of(values, axes, state=TrialState.COMPLETE, value=0.0):
    return [
        create_trial(
            state=state,
            value=value if state == TrialState.COMPLETE else None,
            params=params,
            distributions=distributions(axes),
        )
        for params in values
    ]


def study(objective, axes, sampler, seed, count, batch=1):
    """The trials of a study of a made-up objective, asked in batches."""
    trials, running = [], []
    for number in range(count):
        params = propose(trials + running, axes, sampler, seed)
        running += trials_of([params], axes, TrialState.RUNNING)
        if len(running) == batch or number == count - 1:
            trials += [trials_of([trial.params], axes, value=objective(trial.params))[0] for trial in running]
            running = []
    return trials


@pytest.mark.parametrize("sampler", ["tpe", "random"])
def test_proposals_are_in_their_ranges_and_repeatable(sampler):
    trials = study(lambda params: params["penalty_coef"], AXES, sampler, 0, 16, batch=4)
    again = study(lambda params: params["penalty_coef"], AXES, sampler, 0, 16, batch=4)
    other = study(lambda params: params["penalty_coef"], AXES, sampler, 1, 16, batch=4)
    assert [trial.params for trial in trials] == [trial.params for trial in again]
    assert [trial.params for trial in trials] != [trial.params for trial in other]
    for trial in trials:
        assert trial.params.keys() == {axis.name for axis in AXES}
        for axis in AXES:
            value = trial.params[axis.name]
            assert type(value) is float and axis.low <= value <= axis.high
            assert not axis.values or value in axis.values
    logarithms = np.log10([trial.params["lr"] for trial in trials])
    assert len(set(logarithms)) == 16 and -4 <= logarithms.min() < -3.5 < logarithms.max() <= -3


def test_the_grid_has_each_combination_once_whatever_is_running():
    axes = parse_space("penalty_coef=0..1:0.25,tau=0.01|0.02", "td3_sqt")
    trials = study(lambda params: 0.0, axes, "grid", 0, 10, batch=4)
    assert {(t.params["penalty_coef"], t.params["tau"]) for t in trials} == {
        (coef, tau) for coef in (0, 0.25, 0.5, 0.75, 1) for tau in (0.01, 0.02)
    }


def test_a_trial_that_diverged_counts_as_a_bad_one():
    """What Optuna does with pruned trials: TPE keeps away from them, as from trials with a low value."""
    axes = parse_space("penalty_coef=0..1", "td3_sqt")
    good = trials_of([{"penalty_coef": 0.2 + 0.01 * i} for i in range(8)], axes, value=1.0)
    bad = [{"penalty_coef": 0.7 + 0.01 * i} for i in range(12)]
    pruned = propose(good + trials_of(bad, axes, TrialState.PRUNED), axes, "tpe", 0)
    low = propose(good + trials_of(bad, axes, value=-1.0), axes, "tpe", 0)
    assert pruned == low and pruned["penalty_coef"] < 0.5


def test_samplers_of_different_trials_draw_different_numbers():
    space = {"x": optuna.distributions.FloatDistribution(0, 1)}
    drawn = {optuna.create_study(sampler=make_sampler("random", 0, n)).ask(space).params["x"] for n in range(20)}
    assert len(drawn) == 20


def peak(place):
    """A made-up score over penalty_coef, best at `place`."""
    return lambda coef: float(np.exp(-(((coef - place) / 0.15) ** 2)))


FIXED = (0.0, 0.1, 0.25, 0.5, 1.0)


@pytest.mark.slow
def test_tpe_regrets_less_than_a_fixed_list(capsys):
    """21 studies of 32 trials in batches of 8; the best value is known from a grid of 10,001 coefficients."""
    axes, grid = parse_space("penalty_coef=0..1", "td3_sqt"), np.linspace(0, 1, 10_001)
    generator = np.random.default_rng(0)
    regrets = {"tpe": [], "random": [], "fixed list": []}
    for seed in range(21):
        objective = peak(generator.uniform(0, 1))
        noise = np.random.default_rng(seed)

        def noisy(params, objective=objective, noise=noise):
            return objective(params["penalty_coef"]) + noise.normal(0, 0.05)  # as of few seeds

        best = max(map(objective, grid))
        for sampler in ("tpe", "random"):
            trials = study(noisy, axes, sampler, seed, 32, batch=8)
            winner = max(trials, key=lambda trial: trial.value)
            regrets[sampler].append(best - objective(winner.params["penalty_coef"]))
        chosen = max(FIXED, key=lambda coef: noisy({"penalty_coef": coef}))
        regrets["fixed list"].append(best - objective(chosen))
    medians = {name: float(np.median(values)) for name, values in regrets.items()}
    with capsys.disabled():
        print({name: round(value, 4) for name, value in medians.items()})
    assert medians["tpe"] < medians["fixed list"] / 5
