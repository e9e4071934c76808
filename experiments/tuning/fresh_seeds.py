"""The winner of a study, trained again on seeds that tuning never saw."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from optuna.trial import FrozenTrial, TrialState

from experiments.commandline.arguments import UsageError
from experiments.commandline.flags import MAX_SEED
from experiments.launchers.cell import Cell
from experiments.tuning.batches import Task
from experiments.tuning.study import Study

FOLDER = "final"  # in --out


class Winner(NamedTuple):
    """What is trained on fresh seeds: a study's best trial, or an algorithm that has nothing to tune."""

    task: Task
    study: Study | None  # None: nothing to tune
    trial: FrozenTrial | None  # None: nothing to tune, or all trials diverged

    @property
    def flags(self) -> tuple[str, ...]:
        """The tuned settings, as `--flag=value`."""
        return tuple(f"--{name}={value!r}" for name, value in self.trial.params.items()) if self.trial else ()

    @property
    def command(self) -> tuple[str, ...]:
        """Arguments of experiments.run that train it, without seeds and folders."""
        return (f"--algo={self.task.algo}", f"--env={self.task.env}", *self.flags, *self.task.flags)

    @property
    def diverged(self) -> int:
        """The number of trials in which a member diverged."""
        return sum(trial.state == TrialState.PRUNED for trial in self.study.trials) if self.study else 0

    @property
    def is_trained(self) -> bool:
        """Whether there is something to train."""
        return self.trial is not None or self.study is None


def fresh_seeds(tuned_on: Sequence[int], count: int) -> tuple[int, ...]:
    """The next `count` seeds above those that tuning used. Raises `UsageError` if there are not so many."""
    first = max(tuned_on) + 1
    if first + count - 1 > MAX_SEED:
        raise UsageError(
            f"--seeds={max(tuned_on)}: expects seeds with --final_seeds={count} larger ones up to {MAX_SEED}"
        )
    return tuple(range(first, first + count))


def fresh_cell(winner: Winner, out: Path, seeds: Sequence[int], tuned: str) -> Cell:
    """The run of a winner on fresh seeds.

    Args:
      tuned: how its settings were tuned, which the run records.
    """
    label = f"trial_{winner.trial.number}" if winner.trial else "untuned"
    more = (*winner.flags, *([f"--tuned={tuned}"] if winner.trial else []))
    return winner.task.cell(out / FOLDER, f"{label}_seeds_{seeds[0]}-{seeds[-1]}", seeds, more)
