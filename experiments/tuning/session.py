"""One process's part of a tuning: from the checked command line to the report."""

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import optuna

from experiments.commandline.answers import say
from experiments.commandline.arguments import DIVERGED, DONE, INTERRUPTED, UsageError
from experiments.evidence import formats
from experiments.evidence.groups import Group
from experiments.grids.finished import finished
from experiments.grids.stopping import collected_signals
from experiments.grids.train_cells import train_cells
from experiments.launchers.cell import Cell, Ended
from experiments.running import files, folder_lock
from experiments.tuning import report, score_figure
from experiments.tuning.batches import FOLDER as TRIALS
from experiments.tuning.batches import Task
from experiments.tuning.first_refusal import removed_if_refused
from experiments.tuning.fresh_seeds import Winner, fresh_cell, fresh_seeds, show_only
from experiments.tuning.rounds import OpenLauncher, Rounds
from experiments.tuning.study import FILE, Study, most_trials, open_study
from experiments.tuning.tune_flags import Options
from experiments.tuning.tuner import Pace, Plan, run_study, trial_text

FIGURE = "tuning.png"


class Part(NamedTuple):
    """An algorithm: the tuned one or its baseline."""

    task: Task
    study: Study | None  # None: nothing to tune
    trials: int


class Session:
    """Tunes an algorithm and its baseline, trains the winners on fresh seeds, and writes the report.

    Args:
      retries: as in `train_cells`.
      command: the command line, for the report.
    """

    def __init__(self, options: Options, rounds: Rounds, retries: int, command: str):
        self.options, self.rounds, self.retries, self.command = options, rounds, retries, command
        self.fresh = fresh_seeds(options.seeds, options.final_seeds)
        self.received: list[int] = []  # signals

    def run(self) -> int:
        """Returns the exit code.

        Raises:
          UsageError: the runs cannot be trained, or the folder holds another study. Nothing is written then, except
            that a study that was there before keeps the trials that it asked for. Or: a run of the study cannot be
            read.
          OSError: the folder cannot be written.
        """
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        with collected_signals() as self.received:
            env, folder = self._check()
            if self.received:
                return INTERRUPTED
            out = self.options.out
            new = [path for path in (out / FILE, out / "lock", out) if not path.exists()]
            try:
                with folder_lock.locked(out, say), removed_if_refused(new, out / TRIALS), self.rounds.launcher:
                    return self._tune(env, folder)
            except folder_lock.Busy as busy:
                raise UsageError(f"--out={out}: {busy} is tuning there; expects another folder") from None

    def _check(self) -> tuple[str, str]:
        """The name and the folder of the environment, after a check of all runs (`check_runs`)."""
        options, workers_here, runs = self.options, self.rounds.workers_here, []
        for algo in filter(None, (options.algo, options.baseline)):
            axes = options.axes_of(algo)
            shared = [f"--algo={algo}", f"--env={options.env}", f"--out={options.out}", *options.flags_of(algo)]
            shared += [f"--{axis.name}={axis.low!r}" for axis in axes]
            # As many members as in a batch: what they need does not depend on the values of the settings.
            members = options.batch * len(options.seeds) if workers_here and axes else 1
            runs.append((f"--batch={options.batch}", [*shared, f"--seeds={_joined(range(members))}"]))
            if workers_here:
                runs.append((f"--final_seeds={len(self.fresh)}", [*shared, f"--seeds={_joined(self.fresh)}"]))
        command = [sys.executable, "-m", "experiments.tuning.check_runs", str(max(workers_here, 1)), json.dumps(runs)]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace")
        if done.returncode and not self.received:
            lines = done.stderr.strip().splitlines() or [f"--algo: the check ended with exit code {done.returncode}"]
            raise UsageError(lines[-1])
        env, folder = json.loads(done.stdout.splitlines()[-1]) if not done.returncode else ("", "")
        return env, folder

    def _tune(self, env: str, folder: str) -> int:
        options = self.options
        parts = [self._part(algo, folder) for algo in filter(None, (options.algo, options.baseline))]
        members = sum(part.trials for part in parts) * len(options.seeds) + len(parts) * len(self.fresh)
        pace = Pace(members)
        for part in parts:
            if part.study:
                say(
                    f"{part.task.algo} on {env}: {len(part.study.trials)} of {part.trials} trials were asked for before"
                )
                plan = Plan(part.task, options.out, options.seeds, options.objective, part.trials, self.rounds.workers)
                code = run_study(part.study, plan, self._train, say, lambda: bool(self.received), pace)
                if code not in (DONE, DIVERGED):
                    return code
        winners = [Winner(part.task, part.study, part.study.best if part.study else None) for part in parts]
        for winner in winners:
            if winner.trial:
                say(f"{winner.task.algo}: the best trial is {winner.trial.number}: {trial_text(winner.trial)}")
        cells = {
            winner.task.algo: fresh_cell(winner, options.out, self.fresh, self._tuned(winner)) for winner in winners
        }
        if self.received:
            return INTERRUPTED
        show_only([*cells.values()], options.out, say)
        todo = [cells[w.task.algo] for w in winners if w.is_trained and not finished(cells[w.task.algo])]
        if todo:
            say(f"fresh seeds {self.fresh[0]} to {self.fresh[-1]}: {len(todo)} runs{pace.left}")
        code = self._train(todo, lambda ended: pace.passed(len(self.fresh)))
        if code not in (DONE, DIVERGED):
            return code
        tuned = [
            report.Tuned(winner, report.read_fresh(cells[winner.task.algo].path) if winner.is_trained else None)
            for winner in winners
        ]
        self._report(tuned)
        lost = any(one.group is None or any(group_diverged(one.group)) for one in tuned)
        return DIVERGED if lost else DONE

    def _part(self, algo: str, folder: str) -> Part:
        options = self.options
        task, axes = Task(algo, options.env, folder, options.flags_of(algo)), options.axes_of(algo)
        if not axes:
            return Part(task, None, 0)
        opened = open_study(options.out, algo, options.settings_of(algo))
        study = Study(opened, axes, options.sampler, options.sampler_seed, options.batch)
        return Part(task, study, most_trials(options.trials, axes, options.sampler))

    def _train(self, cells: Sequence[Cell], on_end: Callable[[Ended], None]) -> int:
        launcher, signals = OpenLauncher(self.rounds.launcher), lambda: len(self.received)
        return train_cells(cells, launcher, say, retries=self.retries, signals=signals, on_end=on_end)

    def _tuned(self, winner: Winner) -> str:
        """How a winner was tuned, as its run records it."""
        if winner.study is None:
            return ""
        space = ",".join(map(str, winner.study.axes))
        trials, seeds = len(winner.study.trials), len(self.options.seeds)
        return f"{trials} trials x {seeds} seeds, {self.options.sampler}, {space}"

    def _report(self, tuned: Sequence[report.Tuned]) -> None:
        options = self.options
        setup = report.Setup(
            objective=options.objective,
            tuned_on=options.seeds,
            fresh=self.fresh,
            space=",".join(map(str, options.axes)),
            sampler=options.sampler,
            command=self.command,
        )
        table, figure = report.make_table(tuned, setup), score_figure.draw(tuned, setup)
        text = report.report_text(table, tuned, setup, FIGURE if figure else None)
        contents = {"tuning.md": text.encode(), "tuning.csv": formats.comma_separated(table).encode()}
        contents |= {"trials.csv": report.trials_csv([one.winner for one in tuned]).encode()}
        for name, content in (contents | ({FIGURE: figure} if figure else {})).items():
            with files.atomic_file(options.out / name) as file:
                file.write(content)
        formats.show([table], "terminal")
        for one in tuned:
            if one.winner.is_trained:
                say(report.winner_command(one.winner))
        say(f"written to {options.out}: {', '.join(contents)}")


def group_diverged(group: Group) -> list[bool]:
    """Whether each seed of a group diverged."""
    return [bool(np.isnan(member.columns["return_mean"]).any()) for member in group.members]


def _joined(values: Sequence[int]) -> str:
    return ",".join(map(str, values))
