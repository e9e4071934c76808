"""Details of one run, from its files: settings, versions, how it ended, and the command that repeats it."""

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.evidence import finished_runs, run_settings
from experiments.evidence.cells import NOTHING, number
from experiments.evidence.finished_runs import MemberCurves
from experiments.evidence.groups import OWN_PHYSICS, Group, setting_text
from experiments.evidence.pooling import Collected
from experiments.evidence.run_settings import RunSettings
from experiments.running import files
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.envs.factories import is_factory
from sqt_jax.experiment import make_config

MAX_SUMMARY_BYTES = 10_000_000
STATUSES = ("done", "interrupted", "diverged")
NOT_RECORDED = "not recorded in config.json"


class Setting(NamedTuple):
    """A setting that differs from the algorithm's default."""

    name: str
    value: str
    default: str


class Command(NamedTuple):
    """A command line of the run: of its start, or of a continuation."""

    text: str | None  # None: config.json has none
    label: str
    note: str = ""


class MemberReturns(NamedTuple):
    """One member's final and best return, from its rows of evaluations.csv."""

    seed: int
    swept: tuple[str, ...]
    env_steps: str  # of its last evaluation
    final: str
    best: str
    best_env_steps: str


class Details(NamedTuple):
    """All that a page shows of one run."""

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
    commands: list[Command]  # in order of time
    swept: list[str]
    members: list[MemberReturns]


def read_all(collected: Collected) -> list[Details]:
    """Details of all pooled runs, in the order of the tables. Raises as `read`."""
    curves: dict[Path, list[MemberCurves]] = {}
    for group in collected.groups:
        for member in group.members:
            curves.setdefault(member.run, []).append(member)
    return [read(path, members) for path, members in curves.items()]


def read(path: Path, curves: Sequence[MemberCurves]) -> Details:
    """Details of the run in the folder `path` with the members `curves`.

    Raises:
      UsageError: config.json cannot be read or is damaged.
    """
    run = run_settings.read(path)
    settings, content = run.members[0][1], run.content
    status, end = _end(path, bool(content["resumed"]))
    return Details(
        path=path,
        algo=settings["algo"],
        env=Group(tuple(curves)).env,  # as in the tables
        seeds=tuple(dict.fromkeys(seed for seed, _ in run.members)),
        steps=settings["steps"],
        physics=settings["physics"],
        status=status,
        facts=_facts(content) | end,
        settings=_changed(run),
        versions={str(name): str(value) if value else "not installed" for name, value in content["versions"].items()},
        commands=_commands(content, settings["physics"] == OWN_PHYSICS),
        swept=run.swept,
        members=[_returns(member, run.swept) for member in curves],
    )


def _end(path: Path, resumed: bool) -> tuple[str, dict[str, str]]:
    """How the run ended, and times from summary.json: the wall time of all processes, the others of the last one."""
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
        ("train_seconds", "training of the last process" if resumed else "training", "s"),
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
    tuned = finished_runs.tuned_text(content)
    return {
        "began": str(content.get("started") or NOT_RECORDED),
        "evaluated on": str(content.get("evaluated_on") or NOT_RECORDED),
        **({"environment": content["env_version"]} if "env_version" in content else {}),
        "preset": str(content["preset"]),
        **({"settings tuned on other seeds": tuned} if tuned else {}),
        "device": ", ".join([*dict.fromkeys(words), *cpus]) or NOT_RECORDED,
        "commit": commit.replace("+changes", ", with uncommitted changes"),
    }


def _changed(run: RunSettings) -> list[Setting]:
    """The settings that differ from the algorithm's defaults; none for an unknown algorithm."""
    settings = run.members[0][1]
    if settings["algo"] not in ALGORITHMS:
        return []
    own = settings | {name: tuple(dict.fromkeys(member[name] for _, member in run.members)) for name in run.swept}
    physics = {"physics": OWN_PHYSICS} if settings["physics"] == OWN_PHYSICS else {}  # else the task's default
    default = make_config(settings["algo"], settings["env"], **physics).flat()
    return [
        Setting(name, setting_text(own[name]), setting_text(value))
        for name, value in default.items()
        if own[name] != value
    ]


def _commands(content: Mapping[str, Any], own_env: bool) -> list[Command]:
    found = [_command(content, "Started with", own_env)]
    versions = content["versions"]
    for entry in content["resumed"]:
        entry = entry if isinstance(entry, dict) else {}
        at = entry.get("env_steps")
        where = "" if type(at) is not int or at < 0 else f" at step {at:,}" if at else " from the start"
        command = _command(entry, f"Resumed{where} with", own_env)
        own = entry.get("versions")
        other = {n: v for n, v in own.items() if v != versions.get(n)} if isinstance(own, dict) else {}
        if other:
            changed = ", ".join(f"{name} {value}" for name, value in other.items())
            command = command._replace(note=f"{command.note} Other versions from there on: {changed}.".strip())
        found.append(command)
    return found


def _command(entry: Mapping[str, Any], label: str, own_env: bool) -> Command:
    """A command line for a shell, or a call in Python. Its first recorded word is the path of `experiments/run.py`."""
    words = entry.get("command")
    if not isinstance(words, list) or len(words) < 2 or not all(isinstance(word, str) for word in words):
        return Command(None, label, "config.json has no command that can be repeated.")
    note = ""
    if any(word.lstrip("-").partition("=")[0] == "config" for word in words[1:]):
        note = "It read flags from a file that is not recorded; the resulting settings are below."
    if own_env and not _names_factory(words):
        label = f"{label} (in Python; env is the environment that was handed in)"
        return Command(f"experiments.run.main({['run', *words[1:]]!r}, env=env)", label, note)
    return Command(shlex.join(["python", "-m", "experiments.run", *words[1:]]), label, note)


def _names_factory(words: Sequence[str]) -> bool:
    """Whether a command line has `--env=module:function`, as one word or as two."""
    pairs = zip(words, [*words[1:], ""], strict=True)
    values = [word.partition("=")[2] or after for word, after in pairs if word.lstrip("-").partition("=")[0] == "env"]
    return any(map(is_factory, values))


def _returns(member: MemberCurves, swept: Sequence[str]) -> MemberReturns:
    returns, env_steps = member.columns["return_mean"], member.columns["env_steps"]
    best = int(np.nanargmax(returns)) if np.isfinite(returns).any() else None
    final = float(returns[-1])
    return MemberReturns(
        seed=member.seed,
        swept=tuple(setting_text(member.settings[name]) for name in swept),
        env_steps=f"{int(env_steps[-1]):,}",
        final=f"{NOTHING} (diverged)" if math.isnan(final) else number(final),
        best=NOTHING if best is None else number(float(returns[best])),
        best_env_steps=NOTHING if best is None else f"{int(env_steps[best]):,}",
    )
