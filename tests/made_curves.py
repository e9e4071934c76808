"""Invented learning curves of tabular algorithms."""

import numpy as np

from experiments.theorem.learning_curves import LearningCurves
from experiments.theorem.q_learning import Measurements

STEPS = np.array([100, 1000, 10_000])


def curves(coefs=(None,), tables=1, bias=0.1, error=(3.0, 2.0, 1.0), std=0.0, ratio=0.5, seeds=4):
    """Curves with these quantities, each a number or one per measurement; seeds differ by a little."""
    spread = 1 + 0.01 * np.arange(seeds)[:, None, None]
    shape = (seeds, len(coefs), len(STEPS))

    def filled(value):
        return np.broadcast_to(np.asarray(value, float), shape) * spread

    record = Measurements(
        error_max=filled(error), error_mean=filled(error), bias=filled(bias), std=filled(std), ratio=filled(ratio)
    )
    values = np.ones((seeds, len(coefs), tables, 2, 2))
    return LearningCurves(coefs=tuple(coefs), steps=STEPS, record=record, tables=values)
