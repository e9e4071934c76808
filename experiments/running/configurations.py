"""The configurations of a run, from its command line: settings, preset and environment checked together."""

from typing import Any

from experiments.commandline import flags
from experiments.commandline.arguments import UsageError
from experiments.commandline.presets import preset_settings
from experiments.running import run_config
from sqt_jax.config import ENVIRONMENT, Config
from sqt_jax.envs.factories import is_factory
from sqt_jax.experiment import OWN_PHYSICS, make_config
from sqt_jax.settings import ConfigError
from sqt_jax.types import Environment


def configs_of(options: flags.Options, env: Environment | None = None) -> list[Config]:
    """A configuration for each of `options.configurations`. Whether this machine can train it is not checked.

    Args:
      env: an environment handed in, checked by `check_env`; None: `options.env` names it.

    Raises:
      UsageError: settings are invalid, or have no effect with the algorithm or the environment.
    """
    named_env = env or options.env
    assert options.algo and named_env
    preset: dict[str, Any] = {}
    try:
        default = make_config(options.algo, named_env)
        preset = preset_settings(options.preset, default.algo, default.env)
        settings = preset | options.settings
        return [
            make_config(options.algo, named_env, **settings | dict(zip(options.sweep, values, strict=True)))
            for values in options.configurations
        ]
    except ConfigError as error:
        by_preset = error.setting in preset.keys() - options.settings.keys() - options.sweep.keys()
        raise UsageError(f"{error} (set by --preset={options.preset})" if by_preset else str(error)) from None


def check_env(options: flags.Options, env: Environment | None) -> None:
    """Raises `UsageError` if flags contradict an environment handed in, or need one."""
    by_factory = is_factory(options.env or "")
    for flag in ("physics", "eval_physics") if by_factory else ENVIRONMENT[1:]:
        if env is not None and flag in options.settings:
            raise UsageError(f"--{flag}: has no effect with an environment handed in")
    for flag in ("physics", "eval_physics"):
        if options.settings.get(flag) == OWN_PHYSICS:
            raise UsageError(f"--{flag}={OWN_PHYSICS}: expects an environment handed in: run.main(argv, env=...)")
    if env is None:
        return
    if not isinstance(env, Environment):
        raise UsageError(f"env: expects an Environment (sqt_jax.make_environment), not a {type(env).__name__}")
    if options.env not in (None, env.name) and not by_factory:
        raise UsageError(
            f"--env={options.env}: expects {env.name!r}, the name of the environment handed in, or no --env"
        )
    if not isinstance(env.name, str) or not env.name.isprintable() or not run_config.task_folder(env.name).strip("."):
        raise UsageError(f"env: expects an environment with a name that can name a folder, not {env.name!r}")
