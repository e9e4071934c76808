"""The run of a batch: one `experiments.run` whose members are the batch's trials times the seeds."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from optuna.trial import FrozenTrial

from experiments.commandline.arguments import UsageError
from experiments.evidence import statistics
from experiments.launchers.cell import Cell
from experiments.running import records, run_config
from experiments.tuning.space import Axis
from experiments.tuning.study import BATCH, SAME_AS, Result, attribute
from sqt_jax.one_line import one_line

FOLDER = "trials"  # in --out


class Task(NamedTuple):
    """What every run of a study has in common."""

    algo: str
    env: str
    folder: str  # of the environment, in --out
    flags: tuple[str, ...]  # of every run, as `--flag=value`

    def cell(self, out: Path, name: str, seeds: Sequence[int], more: Sequence[str] = ()) -> Cell:
        """A run of this task below the folder `out`."""
        where = (f"--algo={self.algo}", f"--env={self.env}", f"--out={out}", f"--name={name}", "--resume")
        command = (*where, f"--seeds={','.join(map(str, seeds))}", *more, *self.flags)
        return Cell(task=self.env, algo=self.algo, path=out / self.folder / self.algo / name, command=command)


class Batch(NamedTuple):
    """The trials of a batch that are trained: those whose values no earlier trial has."""

    cell: Cell
    axes: tuple[Axis, ...]
    seeds: tuple[int, ...]
    trials: tuple[FrozenTrial, ...]


def batches_of(
    trials: Sequence[FrozenTrial], task: Task, axes: Sequence[Axis], out: Path, seeds: Sequence[int]
) -> dict[int, Batch]:
    """The batches of a study by number; one whose values were all trained before has none."""
    members: dict[int, list[FrozenTrial]] = {}
    for trial in trials:
        if attribute(trial, SAME_AS) is None:
            members.setdefault(attribute(trial, BATCH), []).append(trial)
    found = {}
    for number, own in members.items():
        lists = [f"--{axis.name}={','.join(repr(trial.params[axis.name]) for trial in own)}" for axis in axes]
        cell = task.cell(out / FOLDER, f"batch_{number:04}", seeds, [*lists, "--paired"])
        found[number] = Batch(cell, tuple(axes), tuple(seeds), tuple(own))
    return found


def read_results(batch: Batch, objective: str) -> dict[int, Result]:
    """The results of a batch whose run has ended, by trial number.

    Args:
      objective: `score`, the best evaluation of the mean over seeds, or `final`, the last one.

    Raises:
      UsageError: the run cannot be read, or is not this batch's.
    """
    path = batch.cell.path
    try:
        run = run_config.read(path)
        table = records.read_evaluations(path / "evaluations.csv")
        count = len(batch.trials) * len(batch.seeds)
        returns = np.stack([records.of_member(table, member, "return_mean") for member in range(count)])
        env_steps = records.of_member(table, 0, "env_steps")
    except (OSError, ValueError, KeyError) as error:
        raise UsageError(f"--out: {path} cannot be read: {one_line(error)}; remove it to train it again") from None
    its = [(m.seed, *(getattr(m.config.agent, axis.name) for axis in batch.axes)) for m in run.members]
    planned = [(seed, *(t.params[axis.name] for axis in batch.axes)) for t in batch.trials for seed in batch.seeds]
    if its != planned:
        raise UsageError(f"--out: {path} has members of another study; expects another folder")
    by_trial = returns.reshape(len(batch.trials), len(batch.seeds), -1)
    return {
        trial.number: result_of(own, env_steps, batch.seeds, objective)
        for trial, own in zip(batch.trials, by_trial, strict=True)
    }


def result_of(returns: np.ndarray, env_steps: np.ndarray, seeds: Sequence[int], objective: str) -> Result:
    """The result of a trial.

    Args:
      returns: [seeds, evaluations]; NaN from the step on at which a member diverged.
      env_steps: [evaluations].
    """
    score = statistics.score(returns)
    chosen = returns.shape[1] - 1 if objective == "final" or score is None else score.evaluation
    values = tuple(float(value) if np.isfinite(value) else None for value in returns[:, chosen])
    diverged = tuple(seed for seed, own in zip(seeds, returns, strict=True) if not np.isfinite(own).all())
    mean = None if diverged else float(returns[:, chosen].mean())
    return Result(mean, values, int(env_steps[chosen]), diverged)
