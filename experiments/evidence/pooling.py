"""Finished runs, pooled over seeds and arranged as rows of algorithms.

- Members with equal settings are pooled, whichever runs they come from: they are one `Group`, which has each seed once.
- Any difference in a setting (a coefficient, the steps, the physics) makes another group.
- Groups of one algorithm on one task become rows, labelled by the settings in which they differ.
- An environment handed in from Python (physics `own`) is pooled under its own name, never with a task of the library.
  Environments of one name and different sizes are different tasks.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from experiments.commandline.arguments import UsageError
from experiments.evidence.finished_runs import MemberCurves, find, read_run
from experiments.evidence.groups import (
    OWN_PHYSICS,
    PENALTY,
    Group,
    differences,
    differences_text,
    setting_text,
)
from experiments.evidence.variants import baseline_of
from sqt_jax import envs
from sqt_jax.algorithms import ALGORITHMS


class AlgorithmRow(NamedTuple):
    """A row of a table: one algorithm, with one value of each setting in which its groups on a task differ."""

    label: str  # the algorithm, and these settings
    algo: str
    groups: dict[str, Group]  # by task

    @property
    def penalty(self) -> str | None:
        """The penalty, where its coefficient is above 0 on some task; else None."""
        penalties = [g.settings["penalty"] for g in self.groups.values() if g.settings["penalty_coef"] > 0]
        return next((name for name in penalties if name != "none"), None)


class Baseline(NamedTuple):
    """The group that an SQT variant's group is compared with."""

    group: Group | None  # None: there is none
    note: str  # why there is none, or why it is not a run of the baseline itself


class Collected(NamedTuple):
    """Pooled runs, as rows times tasks."""

    rows: list[AlgorithmRow]
    tasks: list[str]
    notes: list[str]  # runs that were left out, and why

    @property
    def groups(self) -> list[Group]:
        return [group for row in self.rows for group in row.groups.values()]

    def baseline(self, group: Group) -> Baseline:
        """The group of the baseline with the same settings, except those of the penalty.

        Where the baseline was not run, a group of one of its SQT variants with `penalty_coef` 0 takes its place: it
        trains the same.
        """
        name = baseline_of(group.algo)
        if name == group.algo:
            return Baseline(None, f"{name} has no baseline")
        others = [other for other in self.groups if other.env == group.env and other is not group]
        plain = [other for other in others if other.algo == name]
        for other in plain:
            if not differences(other, group, PENALTY):
                return Baseline(other, "")
        for other in others:
            zero = baseline_of(other.algo) == name and other.settings["penalty_coef"] == 0
            if zero and not differences(other, group, PENALTY):
                return Baseline(
                    other, f"no run of {name}: compared with {other.algo} at penalty_coef 0, which trains the same"
                )
        if not plain:
            return Baseline(None, f"no run of {name} on {group.env} to compare with")
        return Baseline(None, f"not compared: {differences_text(plain[0], group, PENALTY)}")

    def counterparts(self, group: Group, algo: str) -> list[Group]:
        """The groups of another SQT variant with the same task and settings, except those of the penalty."""
        others = [other for other in self.groups if other.env == group.env and other.algo == algo]
        return [other for other in others if not differences(other, group, PENALTY)]


def collect(paths: Sequence[str]) -> Collected:
    """Reads and pools the runs in and below the folders `paths`.

    Raises:
      UsageError: there is no run, a run cannot be read, or two runs have the same seed with the same settings.
    """
    runs, notes = find(paths)
    curves = []
    for path in runs:
        found = read_run(path)
        if not found:
            notes.append(f"left out: {path} has no evaluation yet")
        curves += found
    if not curves:
        raise UsageError("; ".join(notes) or "RUNS: expects folders with runs")
    return arrange(pool(curves), notes)


def pool(curves: Iterable[MemberCurves]) -> list[Group]:
    """Members grouped by their settings.

    Raises:
      UsageError: a group has a seed twice, or its seeds have no evaluation in common.
    """
    pools: dict[tuple, dict[int, MemberCurves]] = {}
    for member in _named_by_size([*curves]):
        seeds = pools.setdefault(tuple(sorted(member.settings.items())), {})
        if member.seed in seeds:
            algo, env = member.settings["algo"], member.settings["env"]
            raise UsageError(
                f"{seeds[member.seed].run} and {member.run}: both have seed {member.seed} of {algo} on {env} with the "
                "same settings; expected only one of them"
            )
        seeds[member.seed] = member
    groups = [Group(tuple(seeds[seed] for seed in sorted(seeds))) for seeds in pools.values()]
    for group in groups:
        if not len(group.env_steps):
            names = ", ".join(dict.fromkeys(str(member.run) for member in group.members))
            raise UsageError(f"{names}: the seeds of {group.algo} on {group.env} have no evaluation in common")
    return groups


def _named_by_size(curves: Sequence[MemberCurves]) -> list[MemberCurves]:
    """The members, with the sizes added to the name of an environment from Python that has several sizes here."""
    sizes: dict[str, set[tuple[int, int] | None]] = {}
    for member in curves:
        if member.settings["physics"] == OWN_PHYSICS:
            sizes.setdefault(member.settings["env"], set()).add(member.own_sizes)
    found = []
    for member in curves:
        env = member.settings["env"]
        if member.own_sizes and member.settings["physics"] == OWN_PHYSICS and len(sizes[env]) > 1:
            observation, action = member.own_sizes
            named = {"env": f"{env} (obs {observation}, action {action})"}
            member = member._replace(settings=member.settings | named)
        found.append(member)
    return found


def arrange(groups: Sequence[Group], notes: Sequence[str] = ()) -> Collected:
    """Groups as rows: algorithms in the order of `ALGORITHMS`, tasks in that of `envs.TASKS`, unknown ones last."""

    def place(name: str, table: Sequence[str]) -> tuple[int, str]:
        return (table.index(name) if name in table else len(table), name)

    algos = sorted({group.algo for group in groups}, key=lambda name: place(name, [*ALGORITHMS]))
    tasks = sorted({group.env for group in groups}, key=lambda name: place(name, [*envs.TASKS]))
    rows = []
    for algo in algos:
        own = [group for group in groups if group.algo == algo]
        varied = [
            name
            for name in dict.fromkeys(name for group in own for name in group.settings)
            if any(len({g.settings.get(name) for g in own if g.env == task}) > 1 for task in tasks)
        ]
        choices = sorted({tuple(group.settings.get(name) for name in varied) for group in own}, key=_order)
        for choice in choices:
            words = [f"{name} {setting_text(value)}" for name, value in zip(varied, choice, strict=True)]
            label = f"{algo} ({', '.join(words)})" if words else algo
            chosen = {g.env: g for g in own if tuple(g.settings.get(name) for name in varied) == choice}
            rows.append(AlgorithmRow(label, algo, {task: chosen[task] for task in tasks if task in chosen}))
    return Collected(rows, tasks, list(notes))


def row_differences(row: AlgorithmRow) -> dict[str, dict[str, Any]]:
    """The settings in which a row's tasks differ: name -> task -> value."""
    found = {}
    for name in next(iter(row.groups.values())).settings:
        values = {task: group.settings.get(name) for task, group in row.groups.items()}
        if name != "env" and len(set(values.values())) > 1:
            found[name] = values
    return found


def _order(values: tuple) -> tuple:
    """A sort key for values of mixed types: numbers before words, missing ones last."""
    return tuple((2, "") if v is None else (1, v) if isinstance(v, str) else (0, v) for v in values)
