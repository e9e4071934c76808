"""From a command line to a plan (settings, folder, devices), checked before anything is written or compiled."""

import dataclasses
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import jax

from experiments.commandline import flag_table, flags
from experiments.commandline.arguments import UsageError
from experiments.running import memory, records, resume, run_config
from experiments.running.configurations import check_env, configs_of
from experiments.running.run_config import Member, RunConfig
from experiments.surroundings import jax_settings
from sqt_jax import envs
from sqt_jax.config import Config, TrainConfig
from sqt_jax.envs import gym_ids
from sqt_jax.experiment import check_physics, named_env
from sqt_jax.members import Layout, usable_devices
from sqt_jax.settings import ConfigError, settings_of
from sqt_jax.types import Environment


class Plan(NamedTuple):
    """Everything a run needs to start or resume."""

    members: list[Member]
    swept: list[str]  # names of the swept settings
    path: Path
    resumed: RunConfig | None  # the run to resume; None: a new one
    output: dict[str, Any]  # the fields of `OutputConfig`
    layout: Layout
    env: Environment
    own_env: Environment | None  # `env`, if it was handed in
    options: flags.Options

    @property
    def config(self) -> Config:
        """The first member's: all members have the same settings except the swept ones."""
        return self.members[0].config

    @property
    def given_env(self) -> Environment | None:
        """What training is given: an environment handed in or on the host; None: it makes the named one."""
        return self.env if self.own_env or self.env.host else None

    @property
    def train(self) -> TrainConfig:
        """Of all members."""
        return self.config.train


class _Target(NamedTuple):
    """The run that a command line refers to."""

    members: list[Member]
    swept: list[str]
    path: Path
    resumed: RunConfig | None


def make_plan(options: flags.Options, env: Environment | None = None) -> Plan:
    """The plan of a command line.

    Args:
      env: an environment handed in. The run is filed and recorded under its name; `options.env` need not be given.

    Raises:
      UsageError: invalid settings, an existing run of the same name, nothing to resume, or too little memory.
    """
    check_env(options, env)
    folder_given = options.resume not in (None, flags.LATEST)
    target = _from_folder(options, env) if folder_given else _from_settings(options, env)
    if target.resumed is None and options.name is not None:  # without one, the run gets a folder of its own
        try:
            if options.overwrite:
                records.removable_files(target.path)
            elif records.is_taken(target.path):
                raise name_taken(target.path)
        except records.NotARun:
            raise not_only_a_run(target.path) from None
        except OSError as error:
            raise UsageError(f"--out={options.out}: expects a folder that can be read: {error}") from None
    config = target.members[0].config
    output = _output(options, target.resumed, config.train)
    used_env = env or _named_env(config, output["env_processes"])
    if used_env.host is None and options.env_processes:
        raise UsageError(f"--env_processes: has no effect with {config.env}; expects an environment of Gymnasium's")
    if used_env.host and used_env.host.processes:
        output["devices"] = _one_device(options.devices)
    layout = _layout(len(target.members), output["devices"], typed=options.devices is not None)
    memory.check(config, layout, used_env)
    return Plan(
        members=target.members,
        swept=target.swept,
        path=target.path,
        resumed=target.resumed,
        output=output,
        layout=layout,
        env=used_env,
        own_env=env,
        options=options,
    )


def _named_env(config: Config, processes: int) -> Environment:
    try:
        return named_env(config, config.physics, processes)
    except ValueError as error:
        flag = f"--env={config.env}" if envs.takes_arguments(config.env) else "--physics"
        raise UsageError(f"{flag}: {error}") from None


def _one_device(given: int | None) -> int:
    if given not in (None, 1):
        raise UsageError(f"--devices={given}: expects 1 with --env_processes: all members share the processes")
    return 1


def _from_settings(options: flags.Options, env: Environment | None) -> _Target:
    """A new run with these settings, or with --resume an existing one."""
    assert options.seeds is not None
    configs = configs_of(options, env)
    in_processes = env.host and env.host.processes if env else options.env_processes
    jax_settings.start_jax(1 if in_processes else options.devices or len(configs) * len(options.seeds))
    if env is None:
        try:
            check_physics(configs[0])
        except ConfigError as error:
            raise UsageError(str(error)) from None
    members, swept = run_config.make_members(options.seeds, configs), list(options.sweep)
    folder = Path(options.out) / run_config.task_folder(configs[0].env) / configs[0].algo
    path = folder / (options.name or _default_name(options))
    if options.resume is None:
        return _Target(members=members, swept=swept, path=path, resumed=None)
    wanted = run_config.all_settings(members, swept) | run_config.sizes_of(env)
    if options.name is None:
        path, run = resume.latest(folder, wanted)
    elif not _exists(path / run_config.NAME):
        # A new run: one command both starts a run and resumes it.
        return _Target(members=members, swept=swept, path=path, resumed=None)
    else:
        run = resume.check(path, resume.read(path), wanted, options.devices)
    return _Target(members=resume.with_original_replay(run), swept=run.swept, path=path, resumed=run)


def _from_folder(options: flags.Options, env: Environment | None) -> _Target:
    """The run in --resume=DIR, whose settings the other flags may repeat."""
    assert options.resume
    path = Path(options.resume)
    wanted: dict[str, Any] = options.settings | options.sweep
    if len(options.sweep) > 1:
        wanted |= run_config.swept_lists([*options.sweep], options.configurations)
    wanted |= {"algo": options.algo} if options.algo else {}
    wanted |= {"seeds": options.seeds} if options.seeds is not None else {}
    run = resume.read(path)
    name = run.members[0].config.env
    if env is not None:
        if not run.on_own_env:
            raise UsageError(f"--resume={path}: expects no environment handed in; the run was trained on {name}")
        wanted |= {"env": env.name} | run_config.sizes_of(env)
    elif run.on_own_env:
        raise UsageError(
            f"--resume={path}: expects the environment {name!r}, by --env=MODULE:FUNCTION or run.main(argv, env=...)"
        )
    elif (module := gym_ids.module_of(name)) and options.env is None:
        raise UsageError(f"--resume={path}: expects --env={name} too, which imports the module {module}")
    elif options.env:
        try:
            wanted["env"] = envs.resolve(options.env)
        except ValueError as error:
            raise UsageError(f"--env: {error}") from None
    run = resume.check(path, run, wanted, options.devices)
    return _Target(members=resume.with_original_replay(run), swept=run.swept, path=path, resumed=run)


def _output(options: flags.Options, run: RunConfig | None, train: TrainConfig) -> dict[str, Any]:
    """The fields of `OutputConfig`: as given, as in the resumed run's config.json, or the defaults."""
    output: dict[str, Any] = dataclasses.asdict(flag_table.OutputConfig())
    if run:
        kept = {name: run.content["output"].get(name) for name in output}
        output |= {name: value for name, value in kept.items() if _is_valid_output(name, value)}
    output |= {name: getattr(options, name) for name in output if getattr(options, name) is not None}
    if options.checkpoint_every is None:  # the default may not be a multiple
        output["checkpoint_every"] -= output["checkpoint_every"] % train.num_envs
    elif options.checkpoint_every % train.num_envs:
        raise UsageError(
            f"--checkpoint_every: expects a multiple of num_envs ({train.num_envs}), not {options.checkpoint_every}"
        )
    return output


def _layout(num_members: int, devices: int | None, typed: bool) -> Layout:
    """The devices that the members are spread over: --devices, or as many as this machine can use.

    Args:
      typed: whether --devices was given now; else `devices` is the resumed run's.
    """
    here = jax.local_devices()
    count = devices or usable_devices(num_members)
    if count > len(here):
        whose = "" if typed else ", and the run was started with more"
        raise UsageError(f"--devices={count}: expects at most {len(here)} here{whose}")
    if count > num_members:
        raise UsageError(f"--devices={count}: expects at most one for each of {num_members} members")
    return Layout(num_members, tuple(here[:count]))


def _default_name(options: flags.Options) -> str:
    changed: dict[str, Any] = {} if options.preset == "paper" else {"preset": options.preset}
    changed |= options.settings | options.sweep | ({"paired": True} if options.paired else {})
    if options.seeds != flag_table.DEFAULT_SEEDS:
        changed["seeds"] = options.seeds
    return run_config.default_name(changed, datetime.now(UTC))


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name that no file can have
        return False


def _is_valid_output(name: str, value: Any) -> bool:
    """Whether a value from config.json is one that the flag accepts."""
    try:
        settings_of(flag_table.OutputConfig)[name].check(value)
    except ConfigError:
        return False
    return True


def not_only_a_run(path: Path) -> UsageError:
    """The error for --overwrite of a folder that holds other files too."""
    return UsageError(
        f"--overwrite: {path} holds other things than a run; expects a folder that holds a run and nothing else"
    )


def name_taken(path: Path) -> UsageError:
    """The error for a name that another run has."""
    return UsageError(
        f"--name={path.name}: {path} already holds a run; expects another name, or --overwrite replaces it"
    )
