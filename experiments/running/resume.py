"""Going on with a run: which one is meant, and whether it is the same."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.commandline.arguments import UsageError
from experiments.running import records, run_config, runtime
from experiments.running.run_config import Described, Member
from sqt_jax.algorithms import check_physics
from sqt_jax.config import ConfigError, check_train

# What may differ from one process of a run to the next: more steps, and what does not change what is trained.
NOT_COMPARED = {"steps"}


def named(path: Path, wanted: Mapping[str, Any], devices: int | None = None) -> Described:
    """The run in the folder `path`, with the number of steps that is `wanted`, if any.

    Args:
      wanted: the settings that were given, by name; those that are swept, and `seeds`, as tuples.
      devices: how many devices were asked for; None is one for each member.

    Raises:
      UsageError: there is no run, or it is another one: the message has the settings that differ.
    """
    try:
        run = run_config.read(path)
        link = records.link_in(path)
    except run_config.NotDescribed as error:
        raise UsageError(f"--resume={path}: expects the folder of a run; {error}") from None
    except OSError as error:
        raise UsageError(f"--resume={path}: expects a folder that can be read: {error.strerror}") from None
    refusal = f"expects a folder that holds the run itself; {link} in it is a link" if link else _refusal(run, wanted)
    if refusal:
        raise UsageError(f"--resume={path}: {refusal}")
    steps = wanted.get("steps", run.members[0].config.train.steps)
    members = [_with_train(_evaluated_on(member, run), steps=steps) for member in run.members]
    runtime.divide_processor(devices or len(members))  # what follows starts JAX
    try:
        check_train(members[0].config.train)
        check_physics(members[0].config)
    except ConfigError as error:
        raise UsageError(str(error)) from None
    return run._replace(members=members)


def latest(folder: Path, wanted: Mapping[str, Any]) -> tuple[Path, Described]:
    """The run in one of the folders in `folder` that is as `wanted`, the one that began last.

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
            run = named(path, wanted)
        except UsageError:
            continue
        found.append((str(run.content.get("started")), path, run))
    if not found:
        raise UsageError(f"--resume: there is no run of these settings in {folder}; expects its folder: --resume=DIR")
    _, path, run = max(found, key=lambda item: item[:2])
    return path, run


def with_its_replay(run: Described) -> list[Member]:
    """The members, with the replay that the run was created with: it does not grow with the number of steps."""
    return [_with_train(member, replay_capacity=run.content["replay_rows"]) for member in run.members]


def other_versions(run: Described) -> list[str]:
    """Packages whose version is not the run's, as `jax 0.9.0 -> 0.10.2`."""
    there, here = run.content["versions"], run_config.versions()
    return [f"{name} {_text(there.get(name))} -> {here[name]}" for name in here if there.get(name) != here[name]]


def _refusal(run: Described, wanted: Mapping[str, Any]) -> str | None:
    its = run_config.settings_of(run.members, run.swept)
    differing = [
        f"{name} (its own: {_text(its.get(name))}, now: {_text(value)})"
        for name, value in wanted.items()
        if name not in NOT_COMPARED and its.get(name) != value
    ]
    if differing:
        return f"expects the run's own settings; these differ: {', '.join(differing)}"
    if wanted.get("steps", its["steps"]) < its["steps"]:
        return f"expects at least the run's own --steps ({its['steps']:,}), not {wanted['steps']:,}"
    there, here = str(run.content["versions"].get("sqt_jax")), str(run_config.versions()["sqt_jax"])
    if there.split(".")[:2] != here.split(".")[:2]:
        return f"expects a run of sqt_jax {'.'.join(here.split('.')[:2])}, not {there[:20]}"
    return None


def _evaluated_on(member: Member, run: Described) -> Member:
    """The member, evaluated on what its run began with: what `auto` chose may be another physics on this machine."""
    physics = run.content.get("evaluated_on") or member.config.eval_physics
    return member._replace(config=dataclasses.replace(member.config, eval_physics=physics))


def _with_train(member: Member, **changes: Any) -> Member:
    train = dataclasses.replace(member.config.train, **changes)
    return member._replace(config=dataclasses.replace(member.config, train=train))


def _text(value: Any) -> str:
    text = ",".join(map(str, value)) if isinstance(value, Sequence) and not isinstance(value, str) else str(value)
    return "".join(filter(str.isprintable, text))[:200]
