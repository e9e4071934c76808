"""Writes and reads a run's config.json: its settings, members, versions and commands.

Keys: `settings` (of the first member), `preset`, `replay_rows` (the replay's capacity per member, fixed when the run is
created), `evaluated_on` (the physics that `eval_physics` chose), `swept` (names), `members` (seed and swept values),
`output` (`flag_table.OutputConfig`), `command`, `started`, `device`, `commit`, `versions`, `resumed` (an entry per
resumption), `own_env` (sizes, only if the environment was handed in), and `env_version` (the package of the environment
and its version, only of gym:ID and the like).
"""

import json
import math
import os
import re
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import jax

from experiments.commandline.flags import MAX_MEMBERS
from experiments.running import files
from sqt_jax import envs
from sqt_jax.config import Config
from sqt_jax.experiment import OWN_PHYSICS, eval_physics_of, make_config
from sqt_jax.job_limits import usable_cores
from sqt_jax.settings import ConfigError
from sqt_jax.types import Environment, Scalars

NAME = "config.json"
MAX_BYTES = 10_000_000
MAX_VERSION = 200  # characters of `env_version`
PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "brax", "gymnasium", "numpy", "sqt_jax")


class Member(NamedTuple):
    """One member of a run: a seed with one value of each swept setting."""

    seed: int
    config: Config


class RunConfig(NamedTuple):
    """A run as recorded in its config.json."""

    members: list[Member]
    swept: list[str]
    content: dict[str, Any]  # of the file

    @property
    def on_own_env(self) -> bool:
        """Whether its environment was handed in."""
        return self.members[0].config.physics == OWN_PHYSICS


class InvalidRunConfig(ValueError):
    """config.json is missing or is not a run's; the text says why."""


def make_members(seeds: Sequence[int], configs: Sequence[Config]) -> list[Member]:
    """Seeds times configurations; seeds vary fastest."""
    return [Member(seed, config) for config, seed in product(configs, seeds)]


def all_settings(members: Sequence[Member], swept: Sequence[str]) -> dict[str, Any]:
    """All settings of a run by name; `seeds` as a tuple, and swept settings as in `swept_lists`."""
    settings = members[0].config.flat() | {"seeds": _values(member.seed for member in members)}
    configurations = [tuple(getattr(member.config.agent, name) for name in swept) for member in members]
    return settings | swept_lists(swept, configurations)


def swept_lists(swept: Sequence[str], configurations: Iterable[tuple[float, ...]]) -> dict[str, Any]:
    """The lists of swept settings by name, and `paired`: whether they are no product.

    Args:
      configurations: the values of the settings `swept`, in the order of the members; repetitions do not count.

    Returns:
      For a product, each value once. Else a value per configuration, so that other pairs give other lists.
    """
    distinct = _values(configurations)
    once = [_values(column) for column in zip(*distinct, strict=True)]
    paired = len(distinct) != math.prod(map(len, once)) or distinct != tuple(product(*once))
    return dict(zip(swept, zip(*distinct, strict=True) if paired else once, strict=True)) | {"paired": paired}


def label(member: Member, swept: Sequence[str]) -> str:
    """A member's name, as `seed=3,penalty_coef=0.5`. `swept`: swept settings other than penalty_coef."""
    words = [f"{name}={getattr(member.config.agent, name):g}" for name in ("penalty_coef", *swept)]
    return ",".join([f"seed={member.seed}", *words])


def sizes_of(env: Environment | None) -> dict[str, int]:
    """The sizes of an environment handed in, for config.json; empty without one."""
    return {"observation_size": env.observation_size, "action_size": env.action_size} if env else {}


def new_content(
    members: Sequence[Member],
    swept: Sequence[str],
    command: Sequence[str],
    preset: str,
    output: Mapping[str, Any],
    own_env: Environment | None = None,
    num_devices: int = 1,
    env_version: str = "",
) -> dict[str, Any]:
    """The content of config.json for a run that starts now on `num_devices` devices."""
    content = {
        "settings": members[0].config.flat(),
        "preset": preset,
        "replay_rows": members[0].config.train.capacity,
        "evaluated_on": eval_physics_of(members[0].config),
        "swept": list(swept),
        "members": [
            {"member": index, "seed": member.seed}
            | {name: getattr(member.config.agent, name) for name in dict.fromkeys(["penalty_coef", *swept])}
            for index, member in enumerate(members)
        ],
        "output": dict(output),
        "command": list(command),
        "started": _now(),
        "device": device_here(num_devices),
        "commit": _commit(),
        "versions": versions(),
        "resumed": [],
    }
    content |= {"own_env": sizes_of(own_env)} if own_env else {}
    return content | ({"env_version": env_version} if env_version else {})


def device_here(num_devices: int) -> dict[str, Any]:
    """What a run computes on: the number of devices, their kind, and the cores that this process may use."""
    device = jax.local_devices()[0]
    kind = {"platform": device.platform, "kind": device.device_kind}
    return kind | {"devices": num_devices, "cores": usable_cores(), "cpus": os.cpu_count()}


def read(path: Path) -> RunConfig:
    """The run in the folder `path`, from its config.json.

    Raises:
      InvalidRunConfig: there is no such file, or it does not describe a run.
    """
    try:
        content = files.read_json(path / NAME, MAX_BYTES)
        settings, swept, entries = dict(content["settings"]), list(content["swept"]), list(content["members"])
        known = set(swept) <= {*Scalars._fields} and len(set(swept)) == len(swept)
        if not known or not 0 < len(entries) <= MAX_MEMBERS:
            raise InvalidRunConfig(f"its {NAME} does not describe a run")
        configs = {
            values: make_config(**settings | dict(zip(swept, values, strict=True)))
            for values in _values(tuple(entry[name] for name in swept) for entry in entries)
        }
        members = [Member(_seed(entry["seed"]), configs[tuple(entry[name] for name in swept)]) for entry in entries]
        kinds = {"output": dict, "versions": dict, "resumed": list, "preset": str, "replay_rows": int}
        for key, kind in kinds.items():
            if not isinstance(content[key], kind):
                raise InvalidRunConfig(f"its {NAME} does not describe a run")
        config, rows = members[0].config, content["replay_rows"]
        if not is_valid_own_env(content.get("own_env", {}), config.env, config.physics):
            raise InvalidRunConfig(f"its {NAME} does not describe a run")
        if not is_valid_version(content.get("env_version", "")):
            raise InvalidRunConfig(f"its {NAME} does not describe a run")
        train = config.train
        if not train.batch_size <= rows <= train.capacity or rows % train.num_envs:
            raise InvalidRunConfig(f"its {NAME} has an invalid replay capacity (replay_rows)")
        physics = (OWN_PHYSICS,) if config.physics == OWN_PHYSICS else envs.physics_of(config.env)
        if content.get("evaluated_on") not in (None, *physics):
            raise InvalidRunConfig(f"its {NAME} has an invalid physics (evaluated_on)")
    except OSError as error:
        raise InvalidRunConfig(f"it has no {NAME} that can be read ({error.strerror})") from None
    except ConfigError as error:
        raise InvalidRunConfig(f"its {NAME} has an invalid setting: {str(error)[:300]}") from None
    except InvalidRunConfig:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise InvalidRunConfig(f"its {NAME} does not describe a run ({type(error).__name__})") from None
    return RunConfig(members, swept, content)


def is_valid_own_env(own_env: Any, env: str, physics: str) -> bool:
    """Whether `own_env` of config.json has sizes and belongs to a printable name; {} where it is missing."""
    if own_env == {}:
        return physics != OWN_PHYSICS or env.isprintable()
    if not isinstance(own_env, dict) or physics != OWN_PHYSICS or not env.isprintable():
        return False
    return all(type(own_env.get(name)) is int and own_env[name] > 0 for name in ("observation_size", "action_size"))


def is_valid_version(version: Any) -> bool:
    """Whether `env_version` of config.json is a short text."""
    return isinstance(version, str) and version.isprintable() and len(version) <= MAX_VERSION


def write(path: Path, content: Mapping[str, Any]) -> None:
    """Writes config.json into the folder `path`, completely or not at all. Raises `OSError`."""
    with files.atomic_file(path / NAME) as file:
        file.write((json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def resumed_content(
    content: dict[str, Any],
    steps: int,
    output: Mapping[str, Any],
    env_steps: int,
    command: Sequence[str],
    num_devices: int = 1,
) -> dict[str, Any]:
    """The content of config.json for a run that is resumed at `env_steps` and trained to `steps`."""
    entry = {"env_steps": env_steps, "at": _now(), "command": list(command)}
    entry |= {"commit": _commit(), "versions": versions(), "device": device_here(num_devices)}
    settings = content["settings"] | {"steps": steps}
    return content | {"settings": settings, "output": dict(output), "resumed": [*content["resumed"], entry]}


def versions() -> dict[str, str | None]:
    """The versions of `PACKAGES` by name; None: not installed."""
    return {name: _version(name) for name in PACKAGES}


def task_folder(env: str) -> str:
    """The name of the folder with the runs on an environment: its own, with `-` where a file name has none of it."""
    return env if envs.is_built_in(env) else re.sub(r"[^A-Za-z0-9._-]", "-", env)


def default_name(changed: Mapping[str, Any], now: datetime) -> str:
    """A run's name from the settings that differ from the defaults, and the time (UTC)."""

    def text(value: Any) -> str:
        return "+".join(map(str, value)) if isinstance(value, tuple) else str(value)

    words = [f"{name}={text(value)}" for name, value in changed.items()]
    # File names have at most 255 bytes; config.json has all settings.
    label = "_".join(words)[:180].replace("/", "-")
    return "_".join(filter(None, [label, now.strftime("%Y%m%dT%H%M%SZ")]))


def _values(values: Any) -> tuple[Any, ...]:
    return tuple(dict.fromkeys(values))


def _seed(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 2**32:
        raise ValueError
    return value


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The commit of the git checkout that this file is in, with `+changes` if files differ; None outside of one."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)  # not some other repository around an installation
        return git("rev-parse", "HEAD") + ("+changes" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None
