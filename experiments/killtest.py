"""Kills trainings, resumes them and compares the results: `python -m experiments.killtest --kills=50`.

Trains without a break first. Then kills trainings (SIGKILL) at random moments and in the middle of writing files,
resumes them with --resume, and compares the results: every array of the training state bit for bit, the replay rows,
and the rows of both tables except their times. One training in five is killed twice.
"""

import sys
import tempfile
from collections.abc import Sequence
from itertools import product
from pathlib import Path

from absl import app, flags, logging

from experiments.endurance.kills import run_kill_test
from experiments.endurance.training_process import TASKS
from sqt_jax.algorithms import ALGORITHMS

FLAGS = flags.FLAGS


def main(argv: Sequence[str]) -> int:
    """Runs the test; returns 1 if a training failed, else 0."""
    del argv
    logging.set_verbosity(logging.WARNING)
    for name, known in (("tasks", TASKS), ("algos", ALGORITHMS)):
        for value in getattr(FLAGS, name):
            if value not in known:
                sys.exit(f"--{name}: expects some of {', '.join(known)}, not {value!r}")
    cases = list(product(FLAGS.tasks, FLAGS.algos))
    with tempfile.TemporaryDirectory() as folder:
        failures = run_kill_test(cases, FLAGS.kills, FLAGS.jobs, Path(folder), lambda line: print(line, flush=True))
    return 1 if failures else 0


if __name__ == "__main__":
    flags.DEFINE_integer("kills", 50, "How many trainings are killed.", lower_bound=1)
    flags.DEFINE_list("tasks", list(TASKS), "tiny: a small environment of its own; ant: Gymnasium's, on MJX.")
    flags.DEFINE_list("algos", ["td3_sqt", "td7_sqt"], "Algorithms.")
    flags.DEFINE_integer("jobs", 2, "Trainings at the same time.", lower_bound=1)
    app.run(main)
