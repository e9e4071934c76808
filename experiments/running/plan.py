"""From a command line to a run that can begin: what is trained, where, and whether it can be."""

import dataclasses
import re
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import jax
import psutil

from experiments.commandline import flag_table, flags
from experiments.commandline.arguments import UsageError
from experiments.commandline.presets import preset_settings
from experiments.running import records, resume, run_config, runtime
from experiments.running.run_config import Described, Member
from sqt_jax import envs
from sqt_jax.algorithms import check_physics, make_config, memory_estimate
from sqt_jax.config import Config, ConfigError, TrainConfig
from sqt_jax.members import Layout, usable_devices
from sqt_jax.settings import settings_of
from sqt_jax.types import Environment


class Plan(NamedTuple):
    """A checked command line: everything a run needs, before anything is written or compiled."""

    members: list[Member]
    swept: list[str]
    path: Path
    resumed: Described | None  # the run to go on with; None is a new one
    output: dict[str, Any]  # the values of `flags.OUTPUT`
    layout: Layout
    env: Environment
    own_env: Environment | None  # which expects the place of the named one
    options: flags.Options

    @property
    def config(self) -> Config:
        """The first member's: all share everything but the swept scalars."""
        return self.members[0].config

    @property
    def train(self) -> TrainConfig:
        return self.config.train


def make_plan(options: flags.Options, env: Environment | None = None) -> Plan:
    """What a command line asks for; `env` expects the place of the environment that it names.

    Raises `UsageError` for settings that cannot be, a directory that is taken and too little memory.
    """
    members, swept, path, run = _named(options) if options.resume in (None, flags.LATEST) else _resumed(options)
    if run is None:
        try:
            if options.overwrite:
                records.run_alone(path)
            elif records.is_taken(path):
                raise UsageError(taken(path))
        except records.NotARun:
            raise UsageError(not_a_run(path)) from None
        except OSError as error:
            raise UsageError(f"--out={options.out}: expects a folder that can be read: {error}") from None
    config = members[0].config
    own_env = env
    try:
        env = own_env or envs.make(config.env, config.physics)
    except ValueError as error:
        raise UsageError(f"--physics: {error}") from None
    output = _output(options, run, config.train)
    layout = _layout(len(members), output["devices"], typed=options.devices is not None)
    needed, free = memory_estimate(config, layout.held, env), _free_memory(len(layout.devices))
    if needed > free:
        raise UsageError(
            f"--replay_capacity={config.train.replay_capacity}: {len(members)} members need about "
            f"{needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free; expects a smaller number, or fewer --seeds"
        )
    return Plan(members, swept, path, run, output, layout, env, own_env, options)


def _named(options: flags.Options) -> tuple[list[Member], list[str], Path, Described | None]:
    """Members and folder of the run that the settings name: a new one, or with --resume the one that is there."""
    assert options.algo and options.env and options.seeds is not None
    preset: dict[str, Any] = {}
    try:
        default = make_config(options.algo, options.env)
        preset = preset_settings(options.preset, default.algo, default.env)
        settings = preset | options.settings
        configs = [
            make_config(options.algo, options.env, **settings | dict(zip(options.sweep, values, strict=True)))
            for values in product(*options.sweep.values())
        ]
        runtime.divide_processor(options.devices or len(configs) * len(options.seeds))  # what follows starts JAX
        check_physics(configs[0])
    except ConfigError as error:
        by_preset = error.setting in preset.keys() - options.settings.keys() - options.sweep.keys()
        raise UsageError(f"{error} (set by --preset={options.preset})" if by_preset else str(error)) from None
    members, swept = run_config.make_members(options.seeds, configs), list(options.sweep)
    folder = Path(options.out) / default.env / default.algo
    path = folder / (options.name or _default_name(options))
    if options.resume is None:
        return members, swept, path, None
    wanted = run_config.settings_of(members, swept)
    if options.name is None:
        path, run = resume.latest(folder, wanted)
    elif not _exists(path / run_config.NAME):
        return members, swept, path, None  # so that one command starts a run and goes on with it
    else:
        run = resume.named(path, wanted, options.devices)
    return resume.with_its_replay(run), run.swept, path, run


def _resumed(options: flags.Options) -> tuple[list[Member], list[str], Path, Described]:
    """Members and folder of the run in --resume=DIR, which the other flags may repeat."""
    assert options.resume
    path = Path(options.resume)
    wanted: dict[str, Any] = options.settings | options.sweep
    wanted |= {"algo": options.algo} if options.algo else {}
    wanted |= {"seeds": options.seeds} if options.seeds is not None else {}
    if options.env:
        try:
            wanted["env"] = envs.resolve(options.env)
        except ValueError as error:
            raise UsageError(f"--env: {error}") from None
    run = resume.named(path, wanted, options.devices)
    return resume.with_its_replay(run), run.swept, path, run


def _output(options: flags.Options, run: Described | None, train: TrainConfig) -> dict[str, Any]:
    """The run's own flags: as given, as the resumed run has them, or the defaults."""
    output: dict[str, Any] = dataclasses.asdict(flag_table.OutputConfig())
    if run:
        kept = {name: run.content["output"].get(name) for name in output}
        output |= {name: value for name, value in kept.items() if _may_be(name, value)}
    output |= {name: getattr(options, name) for name in output if getattr(options, name) is not None}
    if options.checkpoint_every is None:  # the default may not be a multiple
        output["checkpoint_every"] -= output["checkpoint_every"] % train.num_envs
    elif options.checkpoint_every % train.num_envs:
        raise UsageError(
            f"--checkpoint_every: expects a multiple of num_envs ({train.num_envs}), not {options.checkpoint_every}"
        )
    return output


def _layout(num_members: int, devices: int | None, typed: bool) -> Layout:
    """Where the members lie, by --devices; None is chosen here, anew whenever a run goes on: it may do so elsewhere."""
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
    changed |= options.settings | options.sweep
    if options.seeds != flag_table.DEFAULT_SEEDS:
        changed["seeds"] = options.seeds
    return run_config.default_name(changed, datetime.now(UTC))


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name that no file can have
        return False


def _may_be(name: str, value: Any) -> bool:
    try:
        settings_of(flag_table.OutputConfig)[name].check(value)
    except ConfigError:
        return False
    return True


def not_a_run(path: Path) -> str:
    return f"--overwrite: {path} holds other things than a run; expects a folder with a run alone"


def taken(path: Path) -> str:
    return f"--name={path.name}: {path} already holds a run; expects another name, or --overwrite replaces it"


def _free_memory(devices: int) -> int:
    """Bytes that a run may take: the accelerators', or the machine's or its container's that are free."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return devices * (stats["bytes_limit"] - stats.get("bytes_in_use", 0))
    free = psutil.virtual_memory().available
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
        used = int(Path("/sys/fs/cgroup/memory.current").read_text())
        cached = re.search(r"^inactive_file (\d+)$", Path("/sys/fs/cgroup/memory.stat").read_text(), re.MULTILINE)
        reclaimable = int(cached[1]) if cached else 0
        return free if limit == "max" else min(free, int(limit) - used + reclaimable)
    except OSError:
        return free
