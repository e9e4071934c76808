"""Curves of tabular algorithms, made up."""

import numpy as np

from experiments.theorem.claims import Curves
from experiments.theorem.q_learning import Record

STEPS = np.array([100, 1000, 10_000])


def curves(coefs=(None,), tables=1, bias=0.1, error=(3.0, 2.0, 1.0), std=0.0, ratio=0.5, seeds=4):
    """A number or one per checkpoint for each quantity; seeds differ by a little."""
    spread = 1 + 0.01 * np.arange(seeds)[:, None, None]
    shape = (seeds, len(coefs), len(STEPS))

    def filled(value):
        return np.broadcast_to(np.asarray(value, float), shape) * spread

    record = Record(filled(error), filled(error), filled(bias), filled(std), filled(ratio))
    return Curves(tuple(coefs), STEPS, record, np.ones((seeds, len(coefs), tables, 2, 2)))
