"""What one run was, from the files it left: its settings, its versions, how it ended, the command that repeats it."""

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.commandline.arguments import UsageError
from experiments.evidence.cells import NOTHING, number
from experiments.evidence.finished_runs import Curves
from experiments.evidence.pooling import Collected, setting_text
from experiments.running import files, run_config
from sqt_jax.algorithms import make_config

MAX_SUMMARY_BYTES = 10_000_000
STATUSES = ("done", "interrupted", "diverged")
NOT_RECORDED = "not recorded in config.json"


class Setting(NamedTuple):
    name: str
    value: str
    default: str


class Command(NamedTuple):
    text: str | None  # None: there is none in config.json
    label: str
    note: str = ""


class Reached(NamedTuple):
    """What one member reached, by its own rows of evaluations.csv."""

    seed: int
    swept: tuple[str, ...]
    env_steps: str  # of its last evaluation
    final: str
    best: str
    best_env_steps: str


class Details(NamedTuple):
    path: Path
    algo: str
    env: str
    seeds: tuple[int, ...]
    steps: int  # planned
    physics: str
    status: str
    facts: dict[str, str]
    settings: list[Setting]  # those that are not the algorithm's defaults
    versions: dict[str, str]
    commands: list[Command]  # in the order in which they were given
    swept: list[str]
    members: list[Reached]


def read_all(collected: Collected) -> list[Details]:
    """Of all runs that something is known of, in the order of the tables. Raises as `read`."""
    curves: dict[Path, list[Curves]] = {}
    for group in collected.groups:
        for member in group.members:
            curves.setdefault(member.run, []).append(member)
    return [read(path, members) for path, members in curves.items()]


def read(path: Path, curves: Sequence[Curves]) -> Details:
    """The run in the folder `path`, whose members' tables are `curves`.

    Raises:
      UsageError: its config.json does not describe a run.
    """
    try:
        run = run_config.read(path)
    except run_config.InvalidRunConfig as error:
        raise UsageError(f"{path}: {error}") from None
    config, content = run.members[0].config, run.content
    status, end = _end(path, bool(content["resumed"]))
    return Details(
        path,
        config.algo,
        config.env,
        tuple(dict.fromkeys(member.seed for member in run.members)),
        config.train.steps,
        config.physics,
        status,
        _facts(content) | end,
        _changed(run),
        {str(name): str(value) if value else "not installed" for name, value in content["versions"].items()},
        _commands(content),
        run.swept,
        [_reached(member, run.swept) for member in curves],
    )


def _end(path: Path, resumed: bool) -> tuple[str, dict[str, str]]:
    """How it ended, and what summary.json says besides: of all processes the time that it took, else of the last."""
    try:
        summary = files.read_json(path / "summary.json", MAX_SUMMARY_BYTES)
        status = summary["status"]
    except FileNotFoundError:
        return "not ended: no summary.json", {}
    except (OSError, ValueError, TypeError, KeyError):
        return "not known: summary.json cannot be understood", {}
    if status not in STATUSES:
        return "not known: summary.json cannot be understood", {}
    found = {}
    for key, name, unit in (
        ("wall_seconds", "took", "s"),
        ("train_seconds", "training of the last process" if resumed else "of that training", "s"),
        ("steps_per_second", "speed of the last process" if resumed else "speed", "training steps/s"),
    ):
        value = summary.get(key)
        if isinstance(value, int | float) and not isinstance(value, bool):
            found[name] = f"{number(value)} {unit}"
    return status, found


def _facts(content: Mapping[str, Any]) -> dict[str, str]:
    device = content.get("device")
    device = device if isinstance(device, dict) else {}
    words = [str(device[key]) for key in ("platform", "kind") if device.get(key)]
    cpus = [f"{device['cpus']} CPUs"] if device.get("cpus") else []
    commit = str(content.get("commit") or NOT_RECORDED)
    return {
        "began": str(content.get("started") or NOT_RECORDED),
        "evaluated on": str(content.get("evaluated_on") or NOT_RECORDED),
        "preset": str(content["preset"]),
        "device": ", ".join([*dict.fromkeys(words), *cpus]) or NOT_RECORDED,
        "commit": commit.replace("+changes", ", with changes that are in no commit"),
    }


def _changed(run: run_config.RunConfig) -> list[Setting]:
    config = run.members[0].config
    own, default = run_config.settings_of(run.members, run.swept), make_config(config.algo, config.env).flat()
    return [
        Setting(name, setting_text(own[name]), setting_text(value))
        for name, value in default.items()
        if own[name] != value
    ]


def _commands(content: Mapping[str, Any]) -> list[Command]:
    found = [_command(content, "It began with")]
    versions = content["versions"]
    for entry in content["resumed"]:
        entry = entry if isinstance(entry, dict) else {}
        at = entry.get("env_steps")
        where = "" if type(at) is not int or at < 0 else f" at step {at:,}" if at else " from the start"
        command = _command(entry, f"and was gone on with{where} by")
        own = entry.get("versions")
        other = {n: v for n, v in own.items() if v != versions.get(n)} if isinstance(own, dict) else {}
        if other:
            changed = ", ".join(f"{name} {value}" for name, value in other.items())
            command = command._replace(note=f"{command.note} From there on with other versions: {changed}.".strip())
        found.append(command)
    return found


def _command(entry: Mapping[str, Any], label: str) -> Command:
    """A command line as a shell expects it. Its first word was the path of `experiments/run.py`."""
    words = entry.get("command")
    if not isinstance(words, list) or len(words) < 2 or not all(isinstance(word, str) for word in words):
        return Command(None, label, "No command that could be repeated is recorded in config.json.")
    note = ""
    if any(word.lstrip("-").partition("=")[0] == "config" for word in words[1:]):
        note = "It read flags from a file, which config.json does not hold; the settings that came of it are below."
    return Command(shlex.join(["python", "-m", "experiments.run", *words[1:]]), label, note)


def _reached(member: Curves, swept: Sequence[str]) -> Reached:
    returns, env_steps = member.columns["return_mean"], member.columns["env_steps"]
    best = int(np.nanargmax(returns)) if np.isfinite(returns).any() else None
    final = float(returns[-1])
    return Reached(
        member.seed,
        tuple(setting_text(member.settings[name]) for name in swept),
        f"{int(env_steps[-1]):,}",
        f"{NOTHING} (diverged)" if math.isnan(final) else number(final),
        NOTHING if best is None else number(float(returns[best])),
        NOTHING if best is None else f"{int(env_steps[best]):,}",
    )
