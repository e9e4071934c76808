"""The loop of a study: ask a round of batches, train them, tell their results."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from optuna.trial import FrozenTrial

from experiments.commandline.arguments import DIVERGED, DONE, INTERRUPTED, UsageError
from experiments.evidence.cells import number
from experiments.grids.finished import finished
from experiments.launchers.cell import Cell, Ended
from experiments.running.progress import format_seconds
from experiments.tuning.batches import Batch, Task, batches_of, read_results
from experiments.tuning.study import SAME_AS, Study, attribute, best_of

# Trains cells and returns the worst exit code of their runs; calls its second argument with each cell that has ended.
Train = Callable[[Sequence[Cell], Callable[[Ended], None]], int]


class Plan(NamedTuple):
    """What is trained and asked for in a study."""

    task: Task
    out: Path
    seeds: tuple[int, ...]
    objective: str
    trials: int
    workers: int  # batches per round


class Pace:
    """The time that is left, from the time that members took so far.

    Args:
      members: to train in all.
    """

    def __init__(self, members: int, clock: Callable[[], float] = time.monotonic):
        self._left, self._trained, self._clock, self._began = members, 0, clock, clock()

    def passed(self, members: int, trained: bool = True) -> None:
        """Counts members that are done: trained now, or before."""
        self._left -= members
        self._trained += members if trained else 0

    @property
    def left(self) -> str:
        """The time left, as text; empty before anything was trained."""
        if not self._trained:
            return ""
        return f"; {format_seconds((self._clock() - self._began) / self._trained * max(self._left, 0))} left"


def run_study(
    study: Study, plan: Plan, train: Train, say: Callable[[str], None], stop: Callable[[], bool], pace: Pace
) -> int:
    """Trains a study to its end.

    Args:
      say: called with each line to print.
      stop: whether to stop, asked before trials are asked for.

    Returns:
      `DONE`; `INTERRUPTED`; or the exit code of the runs of a round that failed. The same call continues then.

    Raises:
      UsageError, OSError: a run cannot be read, or a result not written. Nothing trains any more then.
    """
    pace.passed((len(study.trials) - len(study.running)) * len(plan.seeds), trained=False)
    errors: list[OSError | UsageError] = []

    def tell_ended(ended: Ended) -> None:
        """Tells the results of a batch; not after an error: what is written after a torn line cannot be read."""
        if ended.code in (DONE, DIVERGED) and not errors:
            try:
                tell_and_say(ended)
            except (OSError, UsageError) as error:  # raised now, it would kill the batches that still train
                errors.append(error)

    def tell_and_say(ended: Ended) -> None:
        batch = next(batch for batch in batches().values() if batch.cell == ended.cell)
        tell_batch(study, batch, plan.objective)
        pace.passed(len(batch.trials) * len(plan.seeds))
        say(f"{batch.cell.label}, {batch.cell.path.name}: {batch_text(study, batch)}{pace.left}")

    def batches() -> dict[int, Batch]:
        return batches_of(study.trials, plan.task, study.axes, plan.out, plan.seeds)

    while True:
        if stop():
            return INTERRUPTED
        # Before anything is told: a round is asked with the results of the rounds before it.
        study.ask_round(plan.trials, 0 if study.running else plan.workers)
        for batch in batches().values():
            if finished(batch.cell):
                tell_batch(study, batch, plan.objective)
        pace.passed(tell_repeated(study) * len(plan.seeds), trained=False)
        running = {trial.number for trial in study.running}
        todo = [batch.cell for batch in batches().values() if running & {trial.number for trial in batch.trials}]
        if todo:
            code = train(todo, tell_ended)
            if errors:
                raise errors[0]
            if code not in (DONE, DIVERGED):
                return code
        elif len(study.trials) >= plan.trials:
            return DONE


def tell_batch(study: Study, batch: Batch, objective: str) -> None:
    """Tells the results of a batch's run for those trials that have none yet."""
    running = [trial for trial in batch.trials if not trial.state.is_finished()]
    if running:
        results = read_results(batch, objective)
        for trial in running:
            study.tell(trial, results[trial.number])


def tell_repeated(study: Study) -> int:
    """Gives trials with the values of an earlier one its result; returns how many."""
    count = 0
    for trial in study.running:
        same = attribute(trial, SAME_AS)
        if same is not None and (result := study.result(same)):
            study.tell(trial, result)
            count += 1
    return count


def batch_text(study: Study, batch: Batch) -> str:
    """The best trial of a batch, how many diverged, and the best trial so far."""
    trials = [study.trials[trial.number] for trial in batch.trials]
    diverged = sum(trial.value is None for trial in trials)
    own, best = best_of(trials), study.best
    words = [f"{len(trials)} trials", *([f"{diverged} diverged"] if diverged else [])]
    words += [f"best {trial_text(own)}"] if own else []
    words += [f"best so far {trial_text(best)}"] if best and own and best.number != own.number else []
    return ", ".join(words)


def trial_text(trial: FrozenTrial) -> str:
    """A trial's value and settings."""
    return f"{number(trial.value)} ({', '.join(f'{name} {value:.4g}' for name, value in trial.params.items())})"
