"""Many random steps of MuJoCo C under a scan: `python -m experiments.soak --steps=10000000`.

Steps all tasks one after another. Prints the number of steps, the memory of the process and unstable steps. Fails if a
number is not finite or the memory grows.
"""

import sys
from collections.abc import Sequence

from absl import app, flags, logging

from experiments.endurance.many_steps import SoakFailure, run_soak
from experiments.surroundings import jax_settings
from sqt_jax.envs import TASKS

FLAGS = flags.FLAGS
flags.DEFINE_integer("steps", 10_000_000, "Environment steps in total.", lower_bound=1)
flags.DEFINE_integer("envs", 64, "Environments in lockstep.", lower_bound=1)
flags.DEFINE_integer("rounds", 5, "How often each task is stepped.", lower_bound=2)


def main(argv: Sequence[str]) -> None:
    """Runs the test; exits with 1 and a line if it fails."""
    del argv
    logging.set_verbosity(logging.WARNING)
    jax_settings.prepare()
    try:
        run_soak(tuple(TASKS), FLAGS.steps, FLAGS.envs, FLAGS.rounds, lambda line: print(line, flush=True))
    except SoakFailure as failure:
        sys.exit(str(failure))


if __name__ == "__main__":
    app.run(main)
