"""Finished runs, gathered: pooled over seeds where every setting agrees, and arranged as rows of algorithms.

Members whose settings are all the same but for the seed are one `Group`, whichever runs they come from. Whatever
differs, a coefficient as well as the steps or the physics, makes another group: groups of one algorithm on one task
become rows of their own, told apart by the settings in which they differ. Nothing is merged that is not alike, and the
same seed twice is refused.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from experiments.commandline.arguments import UsageError
from experiments.evidence import statistics
from experiments.evidence.finished_runs import Curves, find, read_run

# In these alone do an algorithm with SQT and its base differ, where they can be compared.
PENALTY = frozenset({"algo", "penalty", "penalty_coef", "penalty_inside_gamma"})
# What says how long and on what: named in the notes of a table where its cells do not all agree.
PROTOCOL = ("steps", "updates_per_step", "warmup_steps", "physics", "eval_physics", "eval_every", "eval_episodes")


@dataclass(frozen=True)
class Group:
    """Seeds of one algorithm on one task with one setting of everything. What counts is what all its seeds have."""

    members: tuple[Curves, ...]

    @property
    def settings(self) -> dict[str, Any]:
        return self.members[0].settings

    @property
    def env(self) -> str:
        return self.settings["env"]

    @property
    def algo(self) -> str:
        return self.settings["algo"]

    @property
    def seeds(self) -> tuple[int, ...]:
        return tuple(member.seed for member in self.members)

    @cached_property
    def env_steps(self) -> np.ndarray:
        """Where all seeds have an evaluation."""
        common = set.intersection(*(set(member.columns["env_steps"]) for member in self.members))
        return np.array(sorted(common))

    def values(self, column: str) -> np.ndarray:
        """[seeds, evaluations], at `env_steps`; NaN where a seed has not measured it."""
        rows = []
        for member in self.members:
            kept = np.isin(member.columns["env_steps"], self.env_steps)
            rows.append(member.columns[column][kept] if column in member.columns else np.full(kept.sum(), math.nan))
        return np.stack(rows)

    def columns(self, start: str) -> list[str]:
        """The columns whose names start so, which some of its seeds have."""
        names = dict.fromkeys(name for member in self.members for name in member.columns)
        return [name for name in names if name.startswith(start)]

    @cached_property
    def score(self) -> statistics.Score | None:
        return statistics.score(self.values("return_mean"))

    @property
    def scored_at(self) -> int | None:
        """The env steps of the score's evaluation."""
        return None if self.score is None else int(self.env_steps[self.score.evaluation])

    @property
    def scores(self) -> np.ndarray | None:
        """[seeds], the returns at the score's evaluation, whose mean the score is."""
        return None if self.score is None else self.values("return_mean")[:, self.score.evaluation]

    @property
    def finals(self) -> np.ndarray:
        """[seeds], the returns of the last evaluation that all seeds have."""
        return self.values("return_mean")[:, -1]

    def mean_of(self, column: str) -> np.ndarray | None:
        """[seeds], the mean over the evaluations after the first update at which all seeds measured the column."""
        values = self.values(column)
        counted = np.isfinite(values).all(axis=0) & (self.values("gradient_steps") > 0).all(axis=0)
        return values[:, counted].mean(axis=1) if counted.any() else None

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Why it is not all that was planned, a line each; empty where it is."""
        notes = []
        stopped: dict[int, list[int]] = {}
        for member in self.members:
            last = int(member.columns["env_steps"][-1])
            if last < self.settings["steps"]:
                stopped.setdefault(last, []).append(member.seed)
            broken = np.isnan(member.columns["return_mean"])
            if broken.any():
                good = member.columns["env_steps"][: int(np.argmax(broken))]
                since = f"after step {int(good[-1]):,}" if len(good) else "before the first evaluation"
                notes.append(f"seed {member.seed} diverged {since}: no evaluation after that counts")
        for last, seeds in stopped.items():
            word = "seed" if len(seeds) == 1 else "seeds"
            notes.append(f"{word} {_list(seeds)} stopped at step {last:,} of {self.settings['steps']:,}")
        ends = {int(member.columns["env_steps"][-1]) for member in self.members}
        if len(ends) > 1:
            end = int(self.env_steps[-1]) if len(self.env_steps) else 0
            notes.append(f"evaluations up to step {end:,} count, which all its seeds have")
        versions = _differing(member.versions for member in self.members)
        if versions:
            pairs = [f"{name} {_list(values)}" for name, values in versions.items()]
            notes.append(f"seeds from runs with different versions: {'; '.join(pairs)}")
        return tuple(notes)


class Row(NamedTuple):
    """One algorithm with one choice of the settings in which its groups differ on some task."""

    label: str
    algo: str
    groups: dict[str, Group]  # by task


class Base(NamedTuple):
    """What a group is compared with, and what is to be said of it; no group: why there is none."""

    group: Group | None
    note: str


class Collected(NamedTuple):
    rows: list[Row]
    tasks: list[str]
    notes: list[str]  # what was left out

    @property
    def groups(self) -> list[Group]:
        return [group for row in self.rows for group in row.groups.values()]

    def base(self, group: Group) -> Base:
        """The group without a penalty that is alike in everything else.

        Where there is no run of the plain algorithm, another of its forms with `penalty_coef` 0: it trains the same.
        """
        name = base_algorithm(group.algo)
        plain = [other for other in self.groups if other.env == group.env and other.algo == name]
        for other in plain:
            if not differences(other, group, PENALTY):
                return Base(other, "")
        for other in self.groups:
            zero = base_algorithm(other.algo) == name and other.settings["penalty_coef"] == 0
            if zero and other is not group and other.env == group.env and not differences(other, group, PENALTY):
                return Base(
                    other, f"no run of {name}: {other.algo} at penalty_coef 0, which trains the same, is its base"
                )
        if not plain:
            return Base(None, f"no run of {name} on {group.env} to compare with")
        return Base(None, f"not compared: {differing(plain[0], group, PENALTY)}")

    def counterparts(self, group: Group, algo: str) -> list[Group]:
        """The groups of another form of the algorithm that are alike in everything but the penalty."""
        others = [other for other in self.groups if other.env == group.env and other.algo == algo]
        return [other for other in others if not differences(other, group, PENALTY)]


def base_algorithm(algo: str) -> str:
    """`td3` of `td3`, `td3_sqt` and `td3_sqt_tuple`."""
    return algo.removesuffix("_tuple").removesuffix("_sqt")


def setting_text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:g}" if isinstance(value, float) else _list(value) if isinstance(value, tuple) else str(value)


def differences(one: Group, other: Group, ignored: Iterable[str] = ()) -> dict[str, tuple[Any, Any]]:
    """The settings in which two groups differ, with both values."""
    pairs = {name: (value, other.settings.get(name)) for name, value in one.settings.items()}
    return {name: (a, b) for name, (a, b) in pairs.items() if a != b and name not in ignored}


def differing(one: Group, other: Group, ignored: Iterable[str] = ()) -> str:
    """The same in words."""
    found = differences(one, other, ignored)
    pairs = [f"{name} ({setting_text(a)}, {setting_text(b)})" for name, (a, b) in found.items()]
    return f"{one.algo} and {other.algo} on {one.env} differ in {', '.join(pairs)}"


def collect(paths: Sequence[str]) -> Collected:
    """The runs in and below some folders.

    Raises:
      UsageError: there is no run, one cannot be read, or two of them hold the same seed of the same settings.
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


def pool(curves: Iterable[Curves]) -> list[Group]:
    """Groups of equal settings. Raises `UsageError` where one has a seed twice."""
    pools: dict[tuple, dict[int, Curves]] = {}
    for member in curves:
        seeds = pools.setdefault(tuple(sorted(member.settings.items())), {})
        if member.seed in seeds:
            algo, env = member.settings["algo"], member.settings["env"]
            raise UsageError(
                f"{seeds[member.seed].run} and {member.run}: both hold seed {member.seed} of {algo} on {env} with the "
                "same settings; expects one of them"
            )
        seeds[member.seed] = member
    groups = [Group(tuple(seeds[seed] for seed in sorted(seeds))) for seeds in pools.values()]
    for group in groups:
        if not len(group.env_steps):
            names = _list(dict.fromkeys(str(member.run) for member in group.members))
            raise UsageError(f"{names}: seeds of {group.algo} on {group.env} that share no evaluation")
    return groups


def arrange(groups: Sequence[Group], notes: Sequence[str] = ()) -> Collected:
    """Groups as rows: algorithms in the order of their table, tasks in that of theirs."""
    from sqt_jax import algorithms, envs  # brings JAX

    def place(name: str, table: Sequence[str]) -> tuple[int, str]:
        return (table.index(name) if name in table else len(table), name)

    algos = sorted({group.algo for group in groups}, key=lambda name: place(name, [*algorithms.ALGORITHMS]))
    tasks = sorted({group.env for group in groups}, key=lambda name: place(name, [*envs.TASKS]))
    rows = []
    for algo in algos:
        own = [group for group in groups if group.algo == algo]
        varied = [
            name
            for name in own[0].settings
            if any(len({g.settings[name] for g in own if g.env == task}) > 1 for task in tasks)
        ]
        choices = sorted({tuple(group.settings[name] for name in varied) for group in own}, key=_order)
        for choice in choices:
            words = [f"{name} {setting_text(value)}" for name, value in zip(varied, choice, strict=True)]
            label = f"{algo} ({', '.join(words)})" if words else algo
            chosen = {g.env: g for g in own if tuple(g.settings[name] for name in varied) == choice}
            rows.append(Row(label, algo, {task: chosen[task] for task in tasks if task in chosen}))
    return Collected(rows, tasks, list(notes))


def row_differences(row: Row) -> dict[str, dict[str, Any]]:
    """Settings in which a row's tasks differ from each other -> task -> value."""
    found = {}
    for name in next(iter(row.groups.values())).settings:
        values = {task: group.settings[name] for task, group in row.groups.items()}
        if name != "env" and len(set(values.values())) > 1:
            found[name] = values
    return found


def _order(values: tuple) -> tuple:
    return tuple((isinstance(value, str), value) for value in values)


def _differing(mappings: Iterable[Mapping[str, Any]]) -> dict[str, list[Any]]:
    mappings = list(mappings)
    names = dict.fromkeys(name for mapping in mappings for name in mapping)
    values = {name: list(dict.fromkeys(str(mapping.get(name)) for mapping in mappings)) for name in names}
    return {name: found for name, found in values.items() if len(found) > 1}


def _list(values: Iterable[Any]) -> str:
    return ", ".join(map(str, values))
