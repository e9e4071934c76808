"""Errors and speed of our environments against Gymnasium's: `python -m experiments.parity --out=parity.md`.

Compares for each task and version: complete episodes on MuJoCo C with Gymnasium's own environment, single control steps
of each physics from the same states, and starts and episodes in distribution. Measures the speed of five environments
in parallel. Every version of every task is compared unless --tasks names some. Of the benchmark's flags, --tasks,
--physics, --solver, --seconds and --repeats apply here.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from absl import app, flags, logging

from experiments.benchmarks import bench_flags
from experiments.benchmarks.bench_flags import FLAGS, check_flags, exit_on_usage_error, physics_here, solver_limits
from experiments.benchmarks.machine import machine
from experiments.benchmarks.measure_envs import env_steps
from experiments.benchmarks.timing import measure_interleaved
from experiments.commandline import arguments
from experiments.commandline.path_flags import define_path
from experiments.gymnasium_parity.parity_report import Cases, Counts, TaskParity, compare_task, physics_cases, report
from experiments.surroundings import jax_settings
from sqt_jax.envs import TASKS

flags.DEFINE_integer("states", 256, "States from which a control step is compared.", lower_bound=16)
flags.DEFINE_integer("starts", 2_000, "Starts of episodes that are compared.", lower_bound=16)
flags.DEFINE_integer("episodes", 60, "Episodes of a policy with random weights that are compared.", lower_bound=2)
define_path("out", "", "Also write the report, which is always printed, to this file.")

BENCH_FLAGS = ("tasks", "physics", "solver", "seconds", "repeats")  # the benchmark's flags that apply here
for flag_name in BENCH_FLAGS:
    flags.declare_key_flag(flag_name)  # so that --help lists it
MEMBERS = 5  # environments in parallel when speed is measured


@exit_on_usage_error()
@jax_settings.needed_switches()
def main(argv: Sequence[str]) -> None:
    """Checks the flags, compares and prints the report; exits with 1 and a line if a flag is invalid."""
    del argv
    reject_other_bench_flags()
    check_flags()
    if FLAGS.out:
        with exit_on_usage_error():
            arguments.reject_file("--out", Path(FLAGS.out), overwrite=True)
    logging.set_verbosity(logging.WARNING)
    jax_settings.prepare()
    cases = physics_cases(physics_here(), solver_limits())
    counts = Counts(states=FLAGS.states, starts=FLAGS.starts, episodes=FLAGS.episodes)
    found: dict[str, TaskParity] = {}
    speeds: dict[tuple[str, str], float] = {}
    for name in FLAGS.tasks:
        print(f"{name} ...", file=sys.stderr, flush=True)
        found[name] = compare_task(name, cases, counts)
        speeds |= {(name, case): speed for case, speed in measure_speeds(name, cases).items()}
    command = " ".join(["python -m experiments.parity", *sys.argv[1:]])
    text = report(found, speeds, counts.states, MEMBERS, machine(), command)
    print(text)
    if FLAGS.out:
        with exit_on_usage_error():
            arguments.write_file(Path(FLAGS.out), text.encode())


def reject_other_bench_flags() -> None:
    """Exits with one line if a flag was given that applies only to the benchmark."""
    for flag in FLAGS.flags_by_module_dict()[bench_flags.__name__]:
        if flag.present and flag.name not in BENCH_FLAGS:
            names = ", ".join(f"--{name}" for name in BENCH_FLAGS)
            sys.exit(f"--{flag.name}: has no effect here; of the benchmark's flags only {names} apply")


def measure_speeds(name: str, cases: Cases) -> dict[str, float]:
    """Env steps per second of all `MEMBERS` environments of a task, by case; the cases are interleaved."""
    runs = [env_steps(name, MEMBERS, physics, **options) for physics, options in cases.values()]
    rates = measure_interleaved(runs, FLAGS.seconds, FLAGS.repeats)
    return {case: rate * MEMBERS for case, (rate, _) in zip(cases, rates, strict=True)}


if __name__ == "__main__":
    FLAGS.set_default("tasks", list(TASKS))  # the benchmark's default is the paper's tasks
    app.run(main)
