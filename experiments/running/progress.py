"""What a run shows: a live line on a terminal, plain lines elsewhere, nothing with --quiet; a table at the end."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

# Without a terminal there is at most one line in so many seconds, besides one per evaluation.
PLAIN_SECONDS = 10.0


class TimeLeft(NamedTuple):
    seconds: float
    at_least: bool = False  # evaluations are still to come, and how long they take is not known yet

    def __str__(self) -> str:
        return f"{'> ' if self.at_least else ''}{format_seconds(self.seconds)}"


class Status(NamedTuple):
    phase: str
    env_steps: int  # of one member
    steps_per_second: float | None  # environment steps of all members together; None: not measured yet
    left: TimeLeft | None  # None: cannot be told yet
    last_return: float | None  # mean over members and episodes of the last evaluation


def time_left(
    steps_left: Mapping[bool, int],
    steps_per_second: Mapping[bool, float],
    evaluations_left: int,
    seconds_per_evaluation: float | None,
) -> TimeLeft | None:
    """Until the end of a run, or None while steps are to come of a kind that has not been timed.

    `steps_left` and `steps_per_second` are one member's, keyed by whether the steps learn. Evaluations that were not
    timed are left out, which the result says: the second one comes late in a run, or late after it was resumed.
    """
    seconds = 0.0
    for learn, steps in steps_left.items():
        if steps:
            if learn not in steps_per_second:
                return None
            seconds += steps / steps_per_second[learn]
    if evaluations_left and seconds_per_evaluation is None:
        return TimeLeft(seconds, at_least=True)
    return TimeLeft(seconds + evaluations_left * (seconds_per_evaluation or 0.0))


def format_seconds(seconds: float) -> str:
    """`1:02:03` or `2:03`."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02}:{second:02}" if hours else f"{minute}:{second:02}"


def _fields(status: Status) -> dict[str, Any]:
    rate, mean = status.steps_per_second, status.last_return
    return {
        "rate": "-" if rate is None else f"{rate:,.0f}",
        "left": "-" if status.left is None else str(status.left),
        "mean": "-" if mean is None else f"{mean:,.1f}",
    }


class Display:
    """Shows the state of a run on a rich console; a context manager."""

    def __init__(
        self, console: Console, steps: int, *, quiet: bool = False, clock: Callable[[], float] = time.monotonic
    ):
        self.console, self.steps, self.quiet, self.clock = console, steps, quiet, clock
        self._bar: Progress | None = None
        self._last_line = -np.inf
        self._last_phase = ""

    def __enter__(self) -> "Display":
        if self.console.is_terminal and not self.quiet:
            self._bar = Progress(
                SpinnerColumn(),
                TextColumn("{task.description}"),
                BarColumn(bar_width=None),
                TextColumn(
                    "{task.completed:,}/{task.total:,}  {task.fields[rate]} steps/s  return {task.fields[mean]}  "
                    "left {task.fields[left]}"
                ),
                TimeElapsedColumn(),
                console=self.console,
                transient=True,
            )
            self._task = self._bar.add_task("starting", total=self.steps, rate="-", mean="-", left="-")
            self._bar.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        if self._bar:
            self._bar.stop()

    def update(self, status: Status) -> None:
        """Show where the run is; called as often as one likes."""
        fields = _fields(status)
        if self._bar:
            self._bar.update(self._task, description=status.phase, completed=status.env_steps, **fields)
            self._bar.refresh()
            return
        compiling = status.phase.startswith("compiling") and status.phase != self._last_phase
        if not self.quiet and (compiling or self.clock() - self._last_line >= PLAIN_SECONDS):
            self._line(
                f"{status.phase}, step {status.env_steps:,} of {self.steps:,}, {fields['rate']} steps/s, "
                f"return {fields['mean']}, left {fields['left']}"
            )
        self._last_phase = status.phase

    def evaluated(self, env_steps: int, returns: np.ndarray) -> None:
        """One line per evaluation. `returns`: mean return of each member that has not diverged."""
        if not self.quiet and len(returns):
            spread = f" +- {returns.std():,.1f} over {len(returns)} members" if len(returns) > 1 else ""
            self._line(f"step {env_steps:>9,}: return {returns.mean():,.1f}{spread}")

    def message(self, text: str) -> None:
        """A line that is shown even with --quiet."""
        self._line(text)

    def _line(self, text: str) -> None:
        self._last_line = self.clock()
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)


@contextmanager
def counting(
    what: str, total: int, console: Console, clock: Callable[[], float] = time.monotonic
) -> Iterator[Callable[[int], None]]:
    """Shows how much of `total` is done and how long the rest expects; gives the function that is told what is done.

    On a terminal a live line that goes when all is done, elsewhere a line every `PLAIN_SECONDS`.
    """
    if console.is_terminal:
        columns = (TextColumn(what), BarColumn(), TextColumn("{task.completed:,}/{task.total:,}  left"))
        with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as bar:
            task = bar.add_task(what, total=total)
            yield lambda done: bar.update(task, completed=done)
        return
    start = last = clock()

    def tell(done: int) -> None:
        nonlocal last
        now = clock()
        if now - last >= PLAIN_SECONDS and 0 < done < total:
            last = now
            left = format_seconds((now - start) * (total - done) / done)
            line = f"{what}: {done:,} of {total:,}, left {left}"
            console.print(line, highlight=False, markup=False, soft_wrap=True)

    yield tell


def evaluation_share(steps: int, evaluations: int, episodes: int, episode_length: int) -> str:
    """How much of a run is evaluation, said before it starts. Steps and episodes are one member's."""
    evaluated = evaluations * episodes * episode_length
    share = evaluated / (evaluated + steps)
    return (
        f"per member: {steps:,} training steps; {evaluations:,} evaluations of {episodes:,} episodes, up to "
        f"{evaluated:,} steps ({share:.0%} of all)"
    )


def final_table(summary: Mapping[str, Any], swept: Sequence[str]) -> Table:
    """The members of a finished run and, below, the score of each group; from what `records.summarise` gives."""

    def number(value: float | None, digits: int = 1) -> str:
        return "-" if value is None else f"{value:,.{digits}f}"

    columns = ["penalty_coef", *swept]
    table = Table(
        box=SIMPLE_HEAD,
        show_footer=False,
        caption="last rows: the mean over seeds, at the end and at its best evaluation (the paper's score)",
    )
    for name in ("member", "seed", *columns, "final return", "best return", "q_std"):
        table.add_column(name, justify="right")
    diverged = {entry["member"]: entry["env_steps"] for entry in summary["diverged"]}
    for member in summary["members"]:
        table.add_row(
            str(member["member"]) + (" (diverged)" if member["member"] in diverged else ""),
            str(member["seed"]),
            *(f"{member[name]:g}" for name in columns),
            number(member["final_return"]),
            number(member["best_return"]),
            number(member["q_std"], 3),
        )
    table.add_section()
    for group in summary["groups"]:
        final, score = group["final"], group["score"]
        table.add_row(
            "mean +- std",
            f"{len(group['seeds'])} seeds",
            *(f"{group[name]:g}" for name in columns),
            f"{number(final['mean'])} +- {number(final['std'])}",
            f"{number(score['mean'])} +- {number(score['std'])}",
            "",
        )
    return table
