"""The next trial of a study, as a function of the trials before it.

Nothing else is remembered: each trial has a sampler of its own, with a seed made of the study's seed and n. Therefore a
study that was killed and started again proposes what it would have proposed.
"""

import math
import warnings
from collections.abc import Sequence

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from optuna.samplers import BaseSampler, BruteForceSampler, RandomSampler, TPESampler
from optuna.trial import FrozenTrial

from experiments.tuning.space import Axis


def propose(trials: Sequence[FrozenTrial], axes: Sequence[Axis], sampler: str, seed: int) -> dict[str, float]:
    """The values of the trial after `trials`, by setting.

    Args:
      trials: all earlier ones in their order, also those that are running: the sampler keeps away from them.
      sampler: `tpe`, `random` or `grid`. TPE is random until ten trials have ended.
      seed: of the study.
    """
    # In memory: a study in a file would store the values one by one, and a kill could come between them.
    study = optuna.create_study(direction="maximize", sampler=make_sampler(sampler, seed, len(trials)))
    study.add_trials(trials)
    params = study.ask(distributions(axes)).params
    return {axis.name: _on_axis(axis, params[axis.name]) for axis in axes}


def make_sampler(name: str, seed: int, number: int) -> BaseSampler:
    """The sampler for one trial of a study."""
    own_seed = int(np.random.SeedSequence((seed, number)).generate_state(1)[0])
    if name == "tpe":
        return TPESampler(seed=own_seed, constant_liar=True)
    if name == "random":
        return RandomSampler(seed=own_seed)
    assert name == "grid"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return BruteForceSampler(seed=own_seed)


def distributions(axes: Sequence[Axis]) -> dict[str, BaseDistribution]:
    """Optuna's name for the axes. Choices have no order there."""
    return {
        axis.name: CategoricalDistribution(axis.choices)
        if axis.choices
        else FloatDistribution(axis.low, axis.high, log=axis.log, step=axis.step)
        for axis in axes
    }


def _on_axis(axis: Axis, value: float) -> float:
    """The value of a range with a step that is meant: Optuna's may be 0.30000000000000004."""
    return min(axis.values, key=lambda other: math.fabs(other - value)) if axis.step else float(value)
