"""Speed and memory of each part: `python -m experiments.bench --suites=env,update,loop --tasks=ant --members=1,5`.

Suites:
  env         environment steps per second with random actions
  physics     the same on each physics, against MuJoCo without JAX
  update      updates per second of the agent, and their share of the machine's peak of operations
  replay      inserts and samples per second
  loop        environment steps per second of the complete training loop
  checkpoint  checkpoints per second, and how long one blocks training
  growth      updates and samples over the numbers of members and critics and the capacity, with figures
  memory      peak memory of a run
  batches     whole runs: all members in one process, and in 8 processes side by side
  kernels     what a GPU would launch in a lockstep step, by part of the step: compiled for one that is not there
  starts      whole seconds of a run of two steps, with an empty compilation cache and with a filled one
  gpu         all to be known about a GPU, most telling first, each part in a process of its own: see --parts
--suite=gpu and --suite=growth are named sets of flags. --compare=sbx measures another implementation as well.

A measurement compiles a loop (a second to a minute) and reports the median of --repeats timed calls of about --seconds
each. The default is the suites env to checkpoint on four tasks, with three algorithms, 1 and 5 members: about 200
measurements, each roughly 10 to 90 seconds on a CPU with two cores. One measurement:
--suites=update --algos=td3 --tasks=cheetah --members=5 --nopeak

A machine's speed varies. Compare only figures of one command, or of commands that alternate. To compare the
checkouts in two folders OLD and NEW:
  for i in 1 2 3 4 5; do for at in OLD NEW; do
    (cd $at && python -m experiments.bench --suites=update --algos=td3 --tasks=cheetah --nopeak --json=$at$i.json)
  done; done
Compare --devices=1 with --devices=auto in separate commands: with auto and many members the CPU is divided into many
XLA devices, whose threads slow down measurements on one device as well.

A measurement that fails prints a line that begins with `failed`; the others continue, and the exit code is 1. --json is
written again after each measurement.
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
from absl import app, flags, logging

from experiments.benchmarks import bench_flags, compare
from experiments.benchmarks.bench_flags import FLAGS, check_flags
from experiments.benchmarks.machine import machine
from experiments.benchmarks.session import measure_and_save
from experiments.surroundings import jax_settings
from sqt_jax import envs

flags.adopt_module_key_flags(bench_flags)


@bench_flags.exit_on_usage_error()
@jax_settings.needed_switches()
def main(argv: Sequence[str]) -> None:
    """Checks the flags, measures and prints; exits with 1 and a line if a flag is invalid or a measurement failed."""
    del argv
    check_flags()
    logging.set_verbosity(logging.WARNING)
    environment = compare.peer_environment() if FLAGS.compare else {}
    if "gpu" in FLAGS.suites:  # its processes share the GPU's memory with this one
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    jax_settings.prepare()
    jax_settings.start_jax(bench_flags.most_devices())
    jax.config.update("jax_enable_compilation_cache", False)  # compile times are measured
    print(", ".join(f"{key}: {value}" for key, value in machine().items()), flush=True)
    request = bench_flags.request()
    for name in () if FLAGS.physics else envs.PHYSICS:
        if missing := envs.lacks(name):
            print(f"without {name}, which needs {missing}", flush=True)
    with bench_flags.exit_on_usage_error():
        failures = measure_and_save(
            request,
            environment,
            json_path=Path(FLAGS.json) if FLAGS.json else None,
            figures=Path(FLAGS.figures),
            with_peak=FLAGS.peak,
            seconds=FLAGS.seconds,
            repeats=FLAGS.repeats,
        )
    if failures:
        sys.exit(f"{len(failures)} failed: the lines that begin with `failed` say what, and why")


if __name__ == "__main__":
    app.run(main)
