"""A group: the seeds of one algorithm on one task with equal settings, and how two groups differ."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from experiments.evidence import statistics
from experiments.evidence.finished_runs import MemberCurves
from sqt_jax import envs
from sqt_jax.experiment import OWN_PHYSICS

# The settings of the penalty. Only these may differ between an SQT variant and the baseline it is compared with.
PENALTY = frozenset({"algo", "penalty", "penalty_coef", "penalty_inside_gamma"})
# How long was trained, and on what. Captions state these settings, and the cells in which they differ.
PROTOCOL = ("steps", "updates_per_step", "warmup_steps", "physics", "eval_physics", "eval_every", "eval_episodes")


@dataclass(frozen=True)
class Group:
    """All seeds of one algorithm on one task with equal settings.

    Statistics use only the evaluations that every seed has. Stds are over seeds with ddof 0 (population).
    """

    members: tuple[MemberCurves, ...]

    @property
    def settings(self) -> dict[str, Any]:
        return self.members[0].settings

    @property
    def own_env(self) -> bool:
        """Whether the environment was handed in from Python."""
        return self.settings["physics"] == OWN_PHYSICS

    @property
    def env(self) -> str:
        """The task's name. An environment from Python that has the name of a library's task is marked."""
        name = self.settings["env"]
        return f"{name} (own)" if self.own_env and _is_task(name) else name

    @property
    def algo(self) -> str:
        return self.settings["algo"]

    @property
    def seeds(self) -> tuple[int, ...]:
        return tuple(member.seed for member in self.members)

    @property
    def tuned(self) -> tuple[str, ...]:
        """How the settings were tuned, as a footnote; empty if they were not."""
        texts = dict.fromkeys(member.tuned for member in self.members if member.tuned)
        return tuple(f"settings tuned on other seeds: {text}" for text in texts)

    @cached_property
    def env_steps(self) -> np.ndarray:
        """[evaluations], the env steps at which every seed has an evaluation."""
        common = set.intersection(*(set(member.columns["env_steps"]) for member in self.members))
        return np.array(sorted(common))

    def values(self, column: str) -> np.ndarray:
        """A column of evaluations.csv at `env_steps`, [seeds, evaluations]; NaN where a seed has not measured it."""
        rows = []
        for member in self.members:
            kept = np.isin(member.columns["env_steps"], self.env_steps)
            rows.append(member.columns[column][kept] if column in member.columns else np.full(kept.sum(), math.nan))
        return np.stack(rows)

    def columns(self, start: str) -> list[str]:
        """The columns of evaluations.csv that begin with `start` and that at least one seed has."""
        names = dict.fromkeys(name for member in self.members for name in member.columns)
        return [name for name in names if name.startswith(start)]

    @cached_property
    def score(self) -> statistics.Score | None:
        """The best evaluation of the mean over seeds; None where no evaluation is complete."""
        return statistics.score(self.values("return_mean"))

    @property
    def scored_at(self) -> int | None:
        """The env steps of the score's evaluation."""
        return None if self.score is None else int(self.env_steps[self.score.evaluation])

    @property
    def scores(self) -> np.ndarray | None:
        """The returns at the score's evaluation, [seeds]. Their mean is the score."""
        return None if self.score is None else self.values("return_mean")[:, self.score.evaluation]

    @property
    def finals(self) -> np.ndarray:
        """The returns of the last evaluation that every seed has, [seeds]."""
        return self.values("return_mean")[:, -1]

    def mean_of(self, column: str) -> np.ndarray | None:
        """The mean of a column over evaluations, [seeds]; None where no evaluation counts.

        An evaluation counts if it is after the first update and every seed measured the column.
        """
        values = self.values(column)
        counted = np.isfinite(values).all(axis=0) & (self.values("gradient_steps") > 0).all(axis=0)
        return values[:, counted].mean(axis=1) if counted.any() else None

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """What differs from the planned training, a line each; empty for a complete group."""
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
            notes.append(f"only evaluations up to step {end:,} count, because not all seeds have later ones")
        versions = _differing(member.versions for member in self.members)
        if versions:
            pairs = [f"{name} {_list(values)}" for name, values in versions.items()]
            notes.append(f"seeds from runs with different versions: {'; '.join(pairs)}")
        return tuple(notes)


def setting_text(value: Any) -> str:
    """A setting's value as tables, labels and pages show it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:g}" if isinstance(value, float) else _list(value) if isinstance(value, tuple) else str(value)


def differences(one: Group, other: Group, ignored: Iterable[str] = ()) -> dict[str, tuple[Any, Any]]:
    """The settings in which two groups differ, with both values; None where a group does not have the setting."""
    names = dict.fromkeys([*one.settings, *other.settings])
    pairs = {name: (one.settings.get(name), other.settings.get(name)) for name in names}
    return {name: (a, b) for name, (a, b) in pairs.items() if a != b and name not in ignored}


def differences_text(one: Group, other: Group, ignored: Iterable[str] = ()) -> str:
    """`differences` as a line of text."""
    found = differences(one, other, ignored)
    pairs = [f"{name} ({setting_text(a)}, {setting_text(b)})" for name, (a, b) in found.items()]
    return f"{one.algo} and {other.algo} on {one.env} differ in {', '.join(pairs)}"


def _is_task(name: str) -> bool:
    try:
        envs.resolve(name)
    except ValueError:
        return False
    return True


def _differing(mappings: Iterable[Mapping[str, Any]]) -> dict[str, list[Any]]:
    mappings = list(mappings)
    names = dict.fromkeys(name for mapping in mappings for name in mapping)
    values = {name: list(dict.fromkeys(str(mapping.get(name)) for mapping in mappings)) for name in names}
    return {name: found for name, found in values.items() if len(found) > 1}


def _list(values: Iterable[Any]) -> str:
    return ", ".join(map(str, values))
