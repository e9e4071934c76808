"""The winner of a study, trained again on seeds that tuning never saw."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from optuna.trial import FrozenTrial, TrialState

from experiments.commandline.arguments import UsageError
from experiments.commandline.flags import MAX_SEED
from experiments.launchers.cell import Cell
from experiments.running import folder_lock
from experiments.tuning.batches import FOLDER as TRIALS
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


def show_only(cells: Sequence[Cell], out: Path, say: Callable[[str], None]) -> None:
    """Moves the runs of earlier winners from `final/` to `trials/`, and back those of `cells`, with their files.

    Tables, plots and reports of `out` show what is in `final/`: a trial that another one has beaten, or the same seeds
    twice, do not belong there.

    Args:
      cells: one per algorithm, as `fresh_cell` makes them.
      say: called with a line of text for a run that a job still trains, which is not moved, and as in
        `folder_lock.locked`.

    Raises:
      OSError: a run cannot be moved.
    """
    for cell in cells:
        shown = cell.path.parent
        aside = out / TRIALS / shown.relative_to(out / FOLDER)
        for path in _inside(aside):
            if _run_name(path) == cell.path.name and not (shown / path.name).exists():
                _move(path, shown)
        others = [path for path in _inside(shown) if _run_name(path) != cell.path.name]
        training = {path.name for path in others if path.is_dir() and _still_trains(path, say)}
        for name in training:
            say(f"{shown / name} stays there, although it is not the winner's: it still trains")
        for path in others:
            if _run_name(path) not in training:
                _move(path, aside)


def _inside(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def _move(path: Path, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    path.rename(folder / path.name)


def _run_name(path: Path) -> str:
    """The name of the run that a folder or a file beside it belongs to."""
    return path.name.partition(".")[0]


def _still_trains(run: Path, say: Callable[[str], None]) -> bool:
    """Whether a process trains a run: a job of a cluster, whose command was killed."""
    try:
        with folder_lock.locked(run, say):
            return False
    except folder_lock.Busy:
        return True
