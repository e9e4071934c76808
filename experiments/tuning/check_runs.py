"""Checks runs before any of them is asked for or started: settings, environment, memory. A process of its own.

    python -m experiments.tuning.check_runs WORKERS RUNS

RUNS is JSON: for each run the flag that is named if its members do not fit, and its arguments of experiments.run. It
prints the name and the folder of the environment as JSON; or one line, with exit code 2. In a process of its own,
because asking JAX for its devices takes most of a GPU's memory. WORKERS is the number of runs side by side.
"""

import json
import sys
from collections.abc import Sequence

from experiments.commandline import flags
from experiments.commandline.arguments import BAD_USAGE, DONE, UsageError, printable
from experiments.run import own_environment
from experiments.running import memory
from experiments.running.plan import make_plan
from experiments.running.run_config import task_folder
from experiments.surroundings import jax_settings


def check(arguments: Sequence[str], workers: int, flag: str) -> tuple[str, str]:
    """The environment's name and folder. Raises `UsageError`, with `flag` if so many such runs do not fit."""
    options = flags.parse(["run", *arguments])
    assert options
    env = own_environment(options)
    try:
        plan = make_plan(options, env)
        memory.check(plan.config, plan.layout, plan.env, workers)
    except memory.TooLittle as error:
        expects = "expects a smaller number, fewer --seeds or a smaller --replay_capacity"
        raise UsageError(f"{flag}: {error.problem}; {expects}") from None
    finally:
        if env and env.host:
            env.host.close()
    return plan.config.env, task_folder(plan.config.env)


def main(argv: Sequence[str]) -> int:
    """Runs the command line `argv`, program name first; returns the exit code."""
    workers, runs = int(argv[1]), json.loads(argv[2])
    try:
        with jax_settings.needed_switches():
            jax_settings.prepare()
            found = [check(arguments, workers, flag) for flag, arguments in runs]
    except UsageError as error:
        print(printable(str(error)), file=sys.stderr)
        return BAD_USAGE
    print(json.dumps(found[0]))
    return DONE


if __name__ == "__main__":
    sys.exit(main(sys.argv))
