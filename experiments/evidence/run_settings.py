"""A run's settings from its config.json, also where this version does not know the algorithm."""

import math
from pathlib import Path
from typing import Any, NamedTuple

from experiments.commandline.arguments import UsageError
from experiments.commandline.flags import MAX_MEMBERS
from experiments.running import files, run_config
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.experiment import make_config

MAX_TEXT = 100  # characters of a setting


class RunSettings(NamedTuple):
    """The members of a run and its config.json."""

    members: list[tuple[int, dict[str, Any]]]  # seed, all settings by name
    swept: list[str]
    content: dict[str, Any]


def read(path: Path) -> RunSettings:
    """The settings of the run in the folder `path`.

    The settings of an algorithm that has no row in `ALGORITHMS`, as in runs of a newer version, are read as they are.

    Raises:
      UsageError: config.json cannot be read or is damaged.
    """
    try:
        run = run_config.read(path)
    except run_config.InvalidRunConfig as error:
        try:
            content = files.read_json(path / run_config.NAME, run_config.MAX_BYTES)
            if content["settings"]["algo"] in ALGORITHMS:
                raise ValueError
            return _unknown_algorithm(content)
        except (OSError, ValueError, TypeError, KeyError, AttributeError):
            raise UsageError(f"{path}: {error}") from None
    return RunSettings([(member.seed, member.config.flat()) for member in run.members], run.swept, run.content)


def _unknown_algorithm(content: dict[str, Any]) -> RunSettings:
    """Raises ValueError, TypeError, KeyError or AttributeError where `content` does not describe a run."""
    settings = {name: _checked(value) for name, value in content["settings"].items()}
    for name, value in make_config("td3", "cheetah").flat().items():
        if name in settings and type(settings[name]) is not type(value):
            raise ValueError
    for name in ("env", "steps", "physics", "penalty", "penalty_coef"):
        if name not in settings:
            raise ValueError
    kinds = {"swept": list, "versions": dict, "resumed": list, "preset": str, "replay_rows": int}
    if not all(isinstance(content[key], kind) for key, kind in kinds.items()):
        raise ValueError
    if not isinstance(content.get("evaluated_on", ""), str) or not 0 < len(content["members"]) <= MAX_MEMBERS:
        raise ValueError
    if not run_config.is_valid_own_env(content.get("own_env", {}), settings["env"], settings["physics"]):
        raise ValueError
    if not run_config.is_valid_version(content.get("env_version", "")):
        raise ValueError
    members = []
    for entry in content["members"]:
        if type(entry["seed"]) is not int:
            raise ValueError
        own = {name: _checked(entry[name]) for name in content["swept"]}
        if any(type(value) is not type(settings[name]) for name, value in own.items()):
            raise ValueError
        members.append((entry["seed"], settings | own))
    return RunSettings(members, content["swept"], content)


def _checked(value: Any) -> Any:
    """A setting's value. Raises `ValueError` for one that no setting has."""
    if isinstance(value, list) and all(type(part) is int for part in value):
        return tuple(value)
    if isinstance(value, str) and value.isprintable() and len(value) <= MAX_TEXT:
        return value
    if isinstance(value, bool | int) or (isinstance(value, float) and math.isfinite(value)):
        return value
    raise ValueError
