"""The trials of one algorithm in a journal file, which optuna-dashboard opens.

A trial is written with its values and the number of its batch in one line of the file, and its result in another. A
process that is killed at any point therefore leaves whole trials: the next one trains those without a result, and asks
for those that are missing in their round.

A round is what is asked before anything of it is trained: a batch per worker.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import optuna
from optuna.samplers import RandomSampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import FrozenTrial, Trial, TrialState, create_trial

from experiments.commandline.arguments import UsageError
from experiments.tuning.proposals import distributions, propose
from experiments.tuning.space import Axis, grid_size
from sqt_jax.one_line import one_line

FILE = "study.log"
# The lock of a process that was killed is removed after so many seconds; it is held for milliseconds.
LOCK_SECONDS = 3
SETTINGS = "settings"  # the study's attribute with its settings
# Attributes of trials.
BATCH = "batch"  # number of the batch, from 1
ROUND_END = "round_end"  # number of trials when its round is asked completely
SAME_AS = "same_as"  # an earlier trial with the same values, whose result it gets
SCORES, STEP, DIVERGED = "scores", "env_steps", "diverged_seeds"


class Result(NamedTuple):
    """What a trial gave."""

    value: float | None  # None: a member diverged
    scores: tuple[float | None, ...]  # per seed
    env_steps: int | None  # of the evaluation that the value is from
    diverged: tuple[int, ...] = ()  # seeds


class Study:
    """The trials of one algorithm.

    Args:
      study: as `open_study` returns it.
      sampler, seed: as in `propose`.
      batch: trials per batch.
    """

    def __init__(self, study: optuna.Study, axes: Sequence[Axis], sampler: str, seed: int, batch: int):
        self._study, self.axes, self._sampler, self._seed, self._batch = study, axes, sampler, seed, batch

    @property
    def trials(self) -> list[FrozenTrial]:
        """All trials in their order."""
        return self._study.get_trials(deepcopy=False)

    @property
    def running(self) -> list[FrozenTrial]:
        """The trials that have no result yet."""
        return [trial for trial in self.trials if trial.state == TrialState.RUNNING]

    @property
    def best(self) -> FrozenTrial | None:
        """The trial with the highest value, the first of equal ones; None: all diverged."""
        return best_of(self.trials)

    def ask_round(self, most: int, batches: int) -> None:
        """Adds the trials of the next round, or those that are missing in a round that was not asked completely.

        Args:
          most: trials of the whole study.
          batches: of the round.
        """
        trials = self.trials
        end = attribute(trials[-1], ROUND_END) if trials else 0
        if len(trials) >= end:
            end = min(len(trials) + batches * self._batch, most)
        before = [trial for trial in trials if attribute(trial, ROUND_END) != end]
        first_batch = 1 + (attribute(before[-1], BATCH) if before else 0)
        space = distributions(self.axes)
        while len(trials) < end:
            number = len(trials)
            values = propose(trials, self.axes, self._sampler, self._seed)
            same = next((trial.number for trial in trials if trial.params == values), None)
            attributes = {BATCH: first_batch + (number - len(before)) // self._batch, ROUND_END: end, SAME_AS: same}
            self._study.add_trial(
                create_trial(state=TrialState.RUNNING, params=values, distributions=space, user_attrs=attributes)
            )
            trials = self.trials

    def tell(self, trial: FrozenTrial, result: Result) -> None:
        """Writes a running trial's result. A trial that diverged is pruned: samplers take it for a bad one."""
        attributes = {SCORES: result.scores, STEP: result.env_steps, DIVERGED: result.diverged}
        writer = Trial(self._study, trial._trial_id)
        for name, value in attributes.items():
            writer.set_user_attr(name, value)
        if result.value is None:
            self._study.tell(trial.number, state=TrialState.PRUNED)
        else:
            self._study.tell(trial.number, result.value)

    def result(self, number: int) -> Result | None:
        """The result of a trial; None: it has none yet."""
        trial = self.trials[number]
        if not trial.state.is_finished():
            return None
        scores, diverged = attribute(trial, SCORES), attribute(trial, DIVERGED)
        return Result(trial.value, tuple(scores), attribute(trial, STEP), tuple(diverged))


def best_of(trials: Sequence[FrozenTrial]) -> FrozenTrial | None:
    """The trial with the highest value, the first of equal ones; None: none has a value."""
    values = {trial.number: trial.value for trial in trials if trial.value is not None}
    return next((trial for trial in trials if trial.value == max(values.values())), None) if values else None


def most_trials(asked_for: int, axes: Sequence[Axis], sampler: str) -> int:
    """The number of trials of a study: a grid has only so many."""
    size = grid_size(axes) if sampler == "grid" else None
    return asked_for if size is None else min(asked_for, size)


def attribute(trial: FrozenTrial, name: str) -> Any:
    """An attribute that this package gave a trial. Raises `UsageError` if it is missing."""
    if name not in trial.user_attrs:
        raise UsageError(f"--out: expects a study of this command; trial {trial.number} of {FILE} has no {name}")
    return trial.user_attrs[name]


def open_study(folder: Path, algo: str, settings: Mapping[str, Any]) -> optuna.Study:
    """The study of an algorithm in `folder`, which is made if there is none. Other processes do not write there.

    Args:
      settings: what the trials depend on, by name; values that JSON has.

    Raises:
      UsageError: the file is damaged, or the study has other settings.
      OSError: the folder cannot be written.
    """
    path = folder / FILE
    folder.mkdir(parents=True, exist_ok=True)
    _cut_torn_line(path)
    try:
        file = str(path.absolute())
        storage = JournalStorage(JournalFileBackend(file, JournalFileOpenLock(file, LOCK_SECONDS)))
        unused = RandomSampler()  # `propose` makes its own
        if algo in optuna.get_all_study_names(storage):
            study = optuna.load_study(study_name=algo, storage=storage, sampler=unused)
        else:
            study = optuna.create_study(study_name=algo, storage=storage, sampler=unused, direction="maximize")
        its = study.user_attrs.get(SETTINGS)
        trials = study.get_trials(deepcopy=False)
    except OSError:
        raise
    except Exception as error:  # of any type: the file may hold anything
        raise UsageError(f"--out={folder}: expects a folder whose {FILE} is a study; {one_line(error)}") from None
    if its is None and not trials:
        study.set_user_attr(SETTINGS, dict(settings))
    elif differing := _differences(its, settings):
        raise UsageError(f"--out={folder}: expects the settings of the study there; these differ: {differing}")
    return study


def _differences(its: Any, settings: Mapping[str, Any]) -> str:
    if not isinstance(its, dict):
        return "it has none"
    names = dict.fromkeys([*its, *settings])
    return ", ".join(
        f"{name} (its own: {its.get(name)}, now: {settings.get(name)})"
        for name in names
        if its.get(name) != settings.get(name)
    )


def _cut_torn_line(path: Path) -> None:
    """Removes a last line without an end, which a machine that went down has left: Optuna would not read on."""
    if not path.exists():
        return
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        os.truncate(path, whole)
