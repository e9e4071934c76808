"""Resuming a run: which run is meant, and whether its settings are the same."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.commandline.arguments import UsageError
from experiments.running import records, run_config
from experiments.running.run_config import Member, RunConfig
from experiments.surroundings import jax_settings
from sqt_jax.config import check_train
from sqt_jax.experiment import check_physics
from sqt_jax.settings import ConfigError

# Settings that may differ when a run is resumed.
NOT_COMPARED = {"steps"}
EXPECTS_CHECKPOINTS = "expects a run with checkpoints to resume from"


def read(path: Path) -> RunConfig:
    """The run in the folder `path`. Raises `UsageError` if there is none."""
    try:
        run = run_config.read(path)
        link = records.find_link(path)
    except run_config.InvalidRunConfig as error:
        raise UsageError(f"--resume={path}: expects the folder of a run; {error}") from None
    except OSError as error:
        raise UsageError(f"--resume={path}: expects a folder that can be read: {error.strerror}") from None
    if link:
        raise UsageError(f"--resume={path}: expects a folder that holds the run itself; {link} in it is a link")
    return run


def check(path: Path, run: RunConfig, wanted: Mapping[str, Any], devices: int | None = None) -> RunConfig:
    """`run`, with the number of steps in `wanted`, if any.

    Args:
      path: the run's folder.
      wanted: the settings that were given, by name; swept settings and `seeds` as tuples.
      devices: the number of devices that was given; None is one per member.

    Raises:
      UsageError: the run has other settings, which the message lists, or cannot be trained here.
    """
    if problem := _problem(run, wanted):
        raise UsageError(f"--resume={path}: {problem}")
    steps = wanted.get("steps", run.members[0].config.train.steps)
    members = [_with_train(_with_eval_physics(member, run), steps=steps) for member in run.members]
    config = members[0].config
    # One device is faster if it is the only one: XLA has a thread for each.
    in_processes = run.content["output"].get("env_processes")
    jax_settings.start_jax(1 if in_processes else devices or len(members))
    try:
        check_train(config.train)
        if not run.on_own_env:
            check_physics(config)
    except ConfigError as error:
        raise UsageError(str(error)) from None
    return run._replace(members=members)


def latest(folder: Path, wanted: Mapping[str, Any]) -> tuple[Path, RunConfig]:
    """The run in `folder` that was started last of those with the settings `wanted`, and its path.

    Raises:
      UsageError: there is none.
    """
    found = []
    try:
        paths = sorted(folder.iterdir()) if folder.is_dir() else []
    except OSError as error:
        raise UsageError(f"--resume: expects a folder that can be read as --out: {error}") from None
    for path in paths:
        try:
            run = check(path, read(path), wanted)
        except UsageError:
            continue
        found.append((str(run.content.get("started")), path, run))
    if not found:
        raise UsageError(f"--resume: there is no run of these settings in {folder}; expects its folder: --resume=DIR")
    _, path, run = max(found, key=lambda item: item[:2])
    return path, run


def check_may_restart(path: Path, checkpoint_every: object) -> None:
    """Checks that a run without any checkpoint may start at step 0 again.

    It may if it died before its first checkpoint. A run that is past its second checkpoint has lost them, and its
    tables are not overwritten.

    Raises:
      UsageError: it has lost its checkpoints, or never made any.
    """
    problem = f"--resume={path}: {EXPECTS_CHECKPOINTS}; it has none"
    if checkpoint_every == 0 or (path / "summary.json").exists():
        raise UsageError(problem)
    # The first checkpoint is certain to be on disk when the second one is due.
    reached = _last_evaluation(path)
    if isinstance(checkpoint_every, int) and reached > 2 * checkpoint_every:
        raise UsageError(f"{problem}, and its evaluations reach step {reached:,}; remove the folder to start again")


def with_original_replay(run: RunConfig) -> list[Member]:
    """The members with the replay capacity that the run was created with: it does not grow with --steps."""
    return [_with_train(member, replay_capacity=run.content["replay_rows"]) for member in run.members]


def changed_versions(run: RunConfig, env_version: str = "") -> list[str]:
    """Packages whose version is not the run's, as `jax 0.9.0 -> 0.10.2`.

    Args:
      env_version: `Environment.version` now.
    """
    old, new = run.content["versions"], run_config.versions()
    changed = [f"{name} {_text(old.get(name))} -> {new[name]}" for name in new if old.get(name) != new[name]]
    before = run.content.get("env_version", "")
    return [*changed, *([f"{_text(before)} -> {env_version}"] if before != env_version else [])]


def changed_device(run: RunConfig, num_devices: int) -> list[str]:
    """What differs from the device that the run was last trained on, as `cores 4 -> 2`."""
    resumed = run.content["resumed"][-1:]
    entries = [run.content, *(entry for entry in resumed if isinstance(entry, dict))]
    devices = [entry["device"] for entry in entries if isinstance(entry.get("device"), dict)]
    old, new = devices[-1] if devices else {}, run_config.device_here(num_devices)
    compared = [name for name in ("platform", "kind", "devices", "cores") if name in old and old[name] != new[name]]
    return [f"{name} {_text(old[name])} -> {new[name]}" for name in compared]


def _problem(run: RunConfig, wanted: Mapping[str, Any]) -> str | None:
    """Why the run cannot be resumed with the settings `wanted`."""
    own = run.content.get("own_env", {}) | run_config.all_settings(run.members, run.swept)
    differing = [
        f"{name} (its own: {_text(own.get(name))}, now: {_text(value)})"
        for name, value in wanted.items()
        if name not in NOT_COMPARED and own.get(name) != value
    ]
    if differing:
        return f"expects the run's own settings; these differ: {', '.join(differing)}"
    if wanted.get("steps", own["steps"]) < own["steps"]:
        return f"expects at least the run's own --steps ({own['steps']:,}), not {wanted['steps']:,}"
    old, new = str(run.content["versions"].get("sqt_jax")), str(run_config.versions()["sqt_jax"])
    if old.split(".")[:2] != new.split(".")[:2]:
        return f"expects a run of sqt_jax {'.'.join(new.split('.')[:2])}, not {old[:20]}"
    return None


def _last_evaluation(path: Path) -> int:
    """The env steps of the last row of evaluations.csv; 0 if there is none."""
    try:
        return int(max(records.read_evaluations(path / "evaluations.csv")["env_steps"], default=0))
    except (OSError, ValueError, KeyError):
        return 0


def _with_eval_physics(member: Member, run: RunConfig) -> Member:
    """The member, evaluated on the physics that its run started with: `auto` may choose another one on this machine."""
    physics = run.content.get("evaluated_on") or member.config.eval_physics
    return member._replace(config=dataclasses.replace(member.config, eval_physics=physics))


def _with_train(member: Member, **changes: Any) -> Member:
    train = dataclasses.replace(member.config.train, **changes)
    return member._replace(config=dataclasses.replace(member.config, train=train))


def _text(value: Any) -> str:
    text = ",".join(map(str, value)) if isinstance(value, Sequence) and not isinstance(value, str) else str(value)
    return "".join(filter(str.isprintable, text))[:200]
