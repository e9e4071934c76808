"""Train one sweep and record it: `python -m experiments.run --algo=sac_sqt --env=ant --seeds=0,1,2,3,4`."""

import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import jax

from experiments.commandline import flag_table, flags
from experiments.commandline.arguments import BAD_USAGE, DONE, FAILED, INTERRUPTED, UsageError, printable
from experiments.running import run_config
from experiments.surroundings import jax_settings
from sqt_jax.envs import env_args, factories
from sqt_jax.one_line import one_line
from sqt_jax.types import Environment


def own_environment(options: flags.Options) -> Environment | None:
    """The environment of `--env=MODULE:FUNCTION`; None if --env has another form. Raises `UsageError`.

    A resumed run calls the function as it was called before.
    """
    name = options.env or ""
    if not factories.is_factory(name):
        return None
    settings, processes = dict(options.settings), options.env_processes
    if options.resume not in (None, flags.LATEST):
        with suppress(run_config.InvalidRunConfig):  # reported later
            content = run_config.read(Path(options.resume)).content
            settings = content["settings"] | settings
            processes = content["output"].get("env_processes") if processes is None else processes
    steps = settings.get("max_episode_steps", 0)
    try:
        arguments = env_args.parse(settings.get("env_args", ""))
        return factories.make_from(name, arguments, steps, processes if isinstance(processes, int) else 0)
    except ValueError as error:
        raise UsageError(f"--env={name}: {error}") from error


def main(argv: Sequence[str], env: Environment | None = None) -> int:
    """Runs the command line `argv`, program name first; returns the exit code.

    Args:
      env: an environment of your own, recorded and filed under `env.name`. `--env` is then not required. From the
        shell, `--env=MODULE:FUNCTION` calls a function that returns it.
    """
    try:
        if argv and argv[0].startswith("--"):
            raise UsageError(f"argv: expects the program's name first, not {argv[0]!r}")
        options = flags.parse(argv, needs_env=env is None)
        if options is None:
            print(flag_table.help_text())
            return DONE
        with jax_settings.needed_switches():
            jax_settings.prepare()
            env = env or own_environment(options)
            # Imports SciPy, TensorBoard and Orbax: a typing error is reported without waiting for them.
            from experiments.running.plan import make_plan
            from experiments.running.session import start_session

            plan = make_plan(options, env)
            with jax_settings.needed_switches():  # again: the environment's module may have changed them
                return start_session(plan, argv).run()
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        advice = (
            "fewer --seeds or a smaller --replay_capacity need less, and --resume continues from the last checkpoint"
        )
        print(printable(f"out of memory ({one_line(error)}): {advice}"), file=sys.stderr)
        return FAILED
    except UsageError as error:
        print(printable(str(error)), file=sys.stderr)
        return BAD_USAGE
    except KeyboardInterrupt:  # before training starts
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main(sys.argv))
