"""The tabular study: algorithms times MDPs, the claims about them, and the files of the results."""

import functools
import io
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from experiments.commandline import arguments
from experiments.running.progress import format_seconds
from experiments.surroundings import consoles, jax_settings
from experiments.theorem import claims, contraction, mdps, q_learning, summary, value_figure
from experiments.theorem.learning_curves import LearningCurves, Names

TABLE, FIGURE = "table.md", "tabular.png"
FIRST_MEASUREMENT = 100  # steps
MEASUREMENTS_PER_DECADE = 8
Results = dict[Names, LearningCurves]


@dataclass(frozen=True)
class StudySettings:
    """The flags of the study, parsed; their defaults are in `study_flags`."""

    mdps: tuple[str, ...]
    algos: tuple[str, ...]
    coefs: tuple[float, ...]  # of SQT's penalty
    seeds: int
    steps: int  # per member
    tables: int  # of MaxMin and SQT
    ddof: int  # of the std over tables
    greedy: str  # chooses SQT's next action
    gamma: float
    lr_power: float
    epsilon: float
    init_std: float
    weighted_c: float

    def algorithms(self) -> dict[str, q_learning.TabularAlgorithm]:
        """The algorithms by name, with these settings."""
        return q_learning.algorithms(self.tables, self.ddof, self.greedy, self.weighted_c)


@jax_settings.needed_switches()
def run(settings: StudySettings, out: Path, command: str) -> None:
    """Runs the study, prints the results and writes `TABLE` and `FIGURE` into `out`.

    Args:
      command: the command line, for the table's file.

    Raises:
      UsageError: `out` cannot be written.
    """
    jax_settings.prepare()
    console = consoles.console()
    results = _learn_all(settings, console)
    sqt = settings.algorithms()["sqt"]
    expansions = contraction.expansions(sqt, settings.coefs, settings.ddof, contraction.PAIRS)
    found = statements(settings, results, expansions)
    table, ratios = summary.learning_rows(results), summary.expansion_table(expansions)
    console.print(summary.terminal_table([summary.HEADER, *table], left=2))
    console.print(" ".join(summary.LEGEND), highlight=False)
    console.print(summary.terminal_table(ratios, left=0))
    summary.print_statements(console, found)
    text = summary.markdown(command, describe(settings), table, found, ratios)
    picture = io.BytesIO()
    value_figure.draw(results, picture)
    arguments.write_files(out, {TABLE: text.encode(), FIGURE: picture.getvalue()})
    console.print(f"\n{out / TABLE}, {out / FIGURE}", soft_wrap=True, highlight=False, markup=False)


def measuring_steps(steps: int) -> np.ndarray:
    """The steps after which is measured, [C]: evenly spaced in log(steps), the last one is `steps`."""
    count = max(2, 1 + round(MEASUREMENTS_PER_DECADE * math.log10(steps / FIRST_MEASUREMENT)))
    return np.unique(np.round(np.geomspace(FIRST_MEASUREMENT, steps, count)).astype(int))


def models(name: str, seeds: int, gamma: float) -> q_learning.Model:
    """One MDP per seed, stacked, leaves [seeds, ...]; they are equal where the MDP has nothing random."""
    found = [mdps.centred(mdps.MDPS[name](seed), gamma) for seed in range(seeds)]
    return q_learning.model_of(mdps.stack(found), np.stack([mdps.optimal_q(mdp, gamma) for mdp in found]))


def learn(settings: StudySettings) -> Iterator[tuple[Names, LearningCurves, float]]:
    """Runs each algorithm on each MDP; yields the names, the curves, and the share of the work done so far."""
    table = settings.algorithms()
    steps = measuring_steps(settings.steps)
    lengths = jnp.asarray(np.diff(steps, prepend=0), jnp.int32)
    seeds = jnp.arange(settings.seeds)
    # MDPs of one shape share the compiled program.
    programs = {
        algo: jax.jit(
            functools.partial(
                q_learning.sweep,
                algorithm=table[algo],
                gamma=settings.gamma,
                power=settings.lr_power,
                epsilon=settings.epsilon,
                ddof=settings.ddof,
                init_std=settings.init_std,
            )
        )
        for algo in settings.algos
    }
    done, total = 0, len(settings.mdps) * len(settings.algos)
    for mdp in settings.mdps:
        model = models(mdp, settings.seeds, settings.gamma)
        for algo in settings.algos:
            coefs = settings.coefs if table[algo].has_coef else (None,)
            numbers = jnp.array([coef or 0.0 for coef in coefs], jnp.float32)
            learner, record = jax.device_get(programs[algo](model, seeds, numbers, lengths))
            done += 1
            curves = LearningCurves(coefs=coefs, steps=steps, record=record, tables=learner.tables)
            yield (mdp, algo), curves, done / total


def statements(
    settings: StudySettings, results: Results, expansions: list[contraction.Expansion]
) -> list[claims.Statement]:
    """All statements about the paper's claims."""
    return [
        claims.overestimation(results),
        claims.underestimation(results),
        claims.monotone(results),
        claims.convergence(results),
        claims.penalty(results),
        claims.identical(results),
        claims.non_expansion(expansions, settings.tables, settings.gamma, settings.ddof, contraction.PAIRS),
        claims.during_learning(results),
    ]


def describe(settings: StudySettings) -> list[str]:
    """The settings as lines of the table's file."""
    epsilon = settings.epsilon
    return [
        f"{settings.seeds} seeds, {settings.steps:,} steps, gamma {settings.gamma:g}; behaviour "
        + ("uniform" if epsilon == 1 else f"epsilon-greedy, epsilon {epsilon:g}"),
        f"step size 1 / n(s, a)^{settings.lr_power:g}, n the visits from which the table has learned",
        f"MaxMin and SQT: {settings.tables} tables, ddof {settings.ddof}, a' greedy by the {settings.greedy}; weighted "
        f"Double Q: c {settings.weighted_c:g}; initial values "
        + (f"N(0, {settings.init_std:g}^2)" if settings.init_std else "0"),
        "T: the expected target of eq. 13 as theorem/q_learning.py states it; taken from the text of the arXiv paper "
        "(its tables are images, so only numbers quoted in the text are used)",
        *(mdps.ABOUT[name] for name in settings.mdps),
    ]


def _learn_all(settings: StudySettings, console: Console) -> Results:
    """`learn` with progress: a status line on a terminal, else a line per algorithm and MDP."""
    began = time.monotonic()
    results: Results = {}
    with console.status("compiling") as status:
        for names, curves, share in learn(settings):
            results[names] = curves
            passed = time.monotonic() - began
            line = f"{', '.join(names)}: {share:.0%} after {format_seconds(passed)}"
            line += f", {format_seconds(passed / share - passed)} left"
            if console.is_terminal:
                status.update(line)
            else:
                console.print(line, highlight=False)
    return results
