"""What is reported of a tuning: winners on fresh seeds, paired differences, and how optimistic the tuning was."""

import csv
import io
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.evidence import pooling, statistics
from experiments.evidence.cells import (
    NOT_RESAMPLED,
    NOTHING,
    Cell,
    Line,
    Notes,
    ResultTable,
    finite,
    interval,
    joined,
    number,
)
from experiments.evidence.finished_runs import read_run
from experiments.evidence.formats import markdown
from experiments.evidence.groups import Group
from experiments.evidence.paper_tables import spread
from experiments.tuning.fresh_seeds import Winner
from experiments.tuning.study import BATCH, SAME_AS, SCORES, STEP, attribute

WANTED_SEEDS = 10  # fewer give intervals that are much too narrow
FEW = f"fewer than {WANTED_SEEDS} fresh seeds: the intervals are much too narrow"
AT_START = (
    "its best evaluation is the one before training: the score says nothing of the settings; --objective=final or "
    "more --steps would"
)
NAMES = {"score": "score", "final": "return at the end"}


class Tuned(NamedTuple):
    """An algorithm's winner and its run on fresh seeds."""

    winner: Winner
    group: Group | None  # None: nothing was trained, since all trials diverged

    @property
    def settings(self) -> str:
        """The tuned settings, as text."""
        if self.winner.trial is None:
            return NOTHING
        return ", ".join(f"{name} {value:.4g}" for name, value in self.winner.trial.params.items())


class Setup(NamedTuple):
    """What the report says of the tuning itself."""

    objective: str
    tuned_on: tuple[int, ...]  # seeds
    fresh: tuple[int, ...]
    space: str
    sampler: str
    command: str


def read_fresh(path: Path) -> Group:
    """The run in `path` as a group. Raises `UsageError` if it cannot be read."""
    (group,) = pooling.pool(read_run(path))
    return group


def values_of(group: Group | None, objective: str) -> np.ndarray | None:
    """The returns that an objective averages, [seeds]; None if a seed has none."""
    values = None if group is None else group.scores if objective == "score" else group.finals
    return values if values is not None and np.isfinite(values).all() else None


def paired(one: np.ndarray, other: np.ndarray) -> dict[str, float | None]:
    """The mean over seeds of `one - other`, its 95 % bootstrap interval, and the share of seeds where it is positive.

    Args:
      one, other: [seeds], in the same order of seeds. Both of a seed are resampled together.
    """
    gap = one - other
    low, high = statistics.bootstrap(statistics.mean, gap) if len(gap) > 1 else (None, None)
    share = float(((gap > 0) + 0.5 * (gap == 0)).mean())
    return {"difference": float(gap.mean()), "low": finite(low), "high": finite(high), "share": share}


def make_table(tuned: Sequence[Tuned], setup: Setup) -> ResultTable:
    """The table of winners: the tuned algorithm, then its baseline if it has one, and their paired difference."""
    notes, lines, records = Notes(), [], []
    for one in tuned:
        winner, trial = one.winner, one.winner.trial
        tuning = trial.value if trial else None
        fresh = values_of(one.group, setup.objective)
        optimism = tuning - float(fresh.mean()) if tuning is not None and fresh is not None else None
        why = [*(one.group.notes if one.group else ["all its trials diverged"])]
        why += ["nothing of it is tuned: its settings are the given ones"] if winner.study is None else []
        why += [AT_START] if trial and trial.user_attrs.get(STEP) == 0 else []
        why += [FEW] if len(setup.fresh) < WANTED_SEEDS else []
        count = len(winner.study.trials) if winner.study else 0
        trials = f"{count}" + (f" ({winner.diverged} diverged)" if winner.diverged else "")
        cells = [Cell((winner.task.algo,), notes(*why)), Cell((one.settings,)), Cell((trials if count else NOTHING,))]
        cells += [Cell((number(tuning),))]
        record: dict[str, Any] = {"algo": winner.task.algo, "settings": one.settings, "trials": count}
        record |= {"diverged": winner.diverged, "trial": trial.number if trial else None, "tuning": tuning}
        for objective in NAMES:
            values = values_of(one.group, objective)
            found = {} if values is None else spread(values)
            cells.append(Cell((NOTHING,) if values is None else _spread_lines(found, len(values))))
            record |= {f"{objective}_{name}": value for name, value in found.items()}
            record |= {f"{objective}_per_seed": "" if values is None else joined(values)}
        cells.append(Cell((number(optimism, sign=True),)))
        lines.append(Line(cells))
        records.append(record | {"optimism": optimism, "seeds": joined(setup.fresh), "notes": "; ".join(why)})
    sections = [lines]
    if len(tuned) > 1:
        line, record = _difference(tuned[0], tuned[1])
        sections.append([line])
        records.append(record)
    return ResultTable(
        name="tuning",
        title="Tuned settings on fresh seeds",
        header=["algorithm", "settings", "trials", "tuning", *NAMES.values(), "optimism"],
        sections=sections,
        caption=_caption(tuned, setup),
        notes=notes.texts,
        records=records,
    )


def report_text(table: ResultTable, tuned: Sequence[Tuned], setup: Setup, figure: str | None) -> str:
    """The report as Markdown: the table, the figure, and the commands that train the winners."""
    lines = [markdown(table), *([f"![The trials]({figure})", ""] if figure else [])]
    lines += ["The command:", "", f"    {setup.command}", ""]
    lines += ["The winners:", ""]
    for one in tuned:
        if one.winner.is_trained:
            lines += [f"    {winner_command(one.winner)}"]
    return "\n".join(lines) + "\n"


def winner_command(winner: Winner) -> str:
    """The command line that trains a winner with the default seeds."""
    return shlex.join(["python", "-m", "experiments.run", *winner.command])


def trials_csv(winners: Sequence[Winner]) -> str:
    """All trials as CSV."""
    rows = []
    for winner in winners:
        for trial in winner.study.trials if winner.study else ():
            scores = trial.user_attrs.get(SCORES) or ()
            row = {"algo": winner.task.algo, "trial": trial.number, "batch": attribute(trial, BATCH)}
            row |= {"same_as": attribute(trial, SAME_AS), "state": trial.state.name.lower()} | trial.params
            row |= {"value": trial.value, "env_steps": trial.user_attrs.get(STEP)}
            rows.append(row | {"per_seed": " ".join("" if s is None else f"{s:.10g}" for s in scores)})
    columns = list(dict.fromkeys(name for row in rows for name in row))
    stream = io.StringIO()
    writer = csv.DictWriter(stream, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def _difference(one: Tuned, other: Tuned) -> tuple[Line, dict[str, Any]]:
    """The row of paired differences and its numbers."""
    label = f"{one.winner.task.algo} minus {other.winner.task.algo}"
    cells = [Cell((label, "seed by seed")), *(Cell(("",)) for _ in range(3))]
    record: dict[str, Any] = {"algo": label}
    for objective in NAMES:
        x, y = values_of(one.group, objective), values_of(other.group, objective)
        if x is None or y is None:
            cells.append(Cell((NOTHING,)))
            continue
        found = paired(x, y)
        record |= {f"{objective}_{name}": value for name, value in found.items()}
        first = f"{number(found['difference'], sign=True)} {interval(found['low'], found['high'])}".strip()
        cells.append(Cell((first, f"better in {found['share']:.0%} of {len(x)} seeds")))
    return Line([*cells, Cell(("",))]), record


def _spread_lines(found: dict[str, float | None], seeds: int) -> tuple[str, ...]:
    first = f"{number(found['mean'])} ± {number(found['std'])} ({seeds})"
    return (first,) if found["mean_low"] is None else (first, interval(found["mean_low"], found["mean_high"]))


def _caption(tuned: Sequence[Tuned], setup: Setup) -> str:
    text = (
        f"Space {setup.space}, sampler {setup.sampler}. Tuning: the {NAMES[setup.objective]} of the best trial, mean "
        f"over the seeds {_seeds(setup.tuned_on)}. Then each winner was trained again on the seeds "
        f"{_seeds(setup.fresh)}, which tuning never saw: mean ± std over seeds (ddof 0), the number of seeds, and "
        f"below the 95 % bootstrap interval of the mean; {NOT_RESAMPLED}. Optimism: the tuning's value minus the fresh "
        "seeds'. It comes from choosing the best of many trials, and for the score also from its maximum over "
        "evaluations, which few seeds make larger."
    )
    if len(tuned) > 1:
        text += " Last row: the mean of the differences seed by seed; its interval resamples both of a seed together."
        base, own = tuned[1].winner, tuned[0].winner.study
        if base.study is None:
            text += f" {base.task.algo}, the baseline, has nothing to tune in this space."
        else:
            fewer = own and len(base.study.trials) < len(own.trials)
            text += (
                f" {base.task.algo}, the baseline, was tuned over the settings of the space that it has, on the same "
                f"seeds, with {'its whole grid' if fewer else 'as many trials'}."
            )
    return text


def _seeds(seeds: Sequence[int]) -> str:
    consecutive = len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[-1] + 1))
    return f"{seeds[0]} to {seeds[-1]}" if consecutive else ", ".join(map(str, seeds))
