"""Progress of a run: a live line on a terminal, plain lines elsewhere, nothing with --quiet."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

# Seconds between lines without a terminal, in addition to one line per evaluation.
PLAIN_SECONDS = 10.0


class TimeLeft(NamedTuple):
    seconds: float
    at_least: bool = False  # evaluations are left and none has been timed yet

    def __str__(self) -> str:
        return f"{'> ' if self.at_least else ''}{format_seconds(self.seconds)}"


class Status(NamedTuple):
    phase: str
    env_steps: int  # of one member
    steps_per_second: float | None  # environment steps of all members together; None: not measured yet
    left: TimeLeft | None  # None: not known yet
    last_return: float | None  # mean over members and episodes of the last evaluation


def time_left(
    steps_left: Mapping[bool, int],
    steps_per_second: Mapping[bool, float],
    evaluations_left: int,
    seconds_per_evaluation: float | None,
) -> TimeLeft | None:
    """Time until the end of a run; None if warm-up or learning steps are left that have not been timed yet.

    `steps_left` and `steps_per_second` are one member's, keyed by whether the steps learn. Before an evaluation has
    been timed, the result is a lower bound without evaluations.
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
        """Shows how far the run is. May be called at any rate."""
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

    def evaluated(self, env_steps: int, returns: np.ndarray, lengths: np.ndarray, speeds: np.ndarray) -> None:
        """Prints a line for an evaluation.

        Args:
          returns, lengths, speeds: [members, episodes] of the members that have not diverged; a speed (m/s) is NaN if
            the task has none.
        """
        if self.quiet or not len(returns):
            return
        means = returns.mean(axis=1)
        spread = f" +- {means.std():,.1f} over {len(means)} members" if len(means) > 1 else ""
        speed = "" if np.isnan(speeds).all() else f", speed {np.nanmean(speeds):.2f} m/s"
        length = f", length {lengths.mean():,.0f}{speed}"
        self._line(f"step {env_steps:>9,}: return {means.mean():,.1f}{spread}{length}")

    def message(self, text: str) -> None:
        """Prints a line, even with --quiet."""
        self._line(text)

    def _line(self, text: str) -> None:
        self._last_line = self.clock()
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)


@contextmanager
def counting(
    what: str, total: int, console: Console, clock: Callable[[], float] = time.monotonic
) -> Iterator[Callable[[int], None]]:
    """Shows how much of `total` is done and the time left; yields the function to call with the amount done.

    On a terminal this is a live line, removed at the end; elsewhere a line every `PLAIN_SECONDS`.
    """
    if console.is_terminal:
        columns = (TextColumn(what), BarColumn(), TextColumn("{task.completed:,}/{task.total:,}  left"))
        with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as bar:
            task = bar.add_task(what, total=total)
            yield lambda done: bar.update(task, completed=done)
        return
    start = last = clock()

    def update(done: int) -> None:
        nonlocal last
        now = clock()
        if now - last >= PLAIN_SECONDS and 0 < done < total:
            last = now
            left = format_seconds((now - start) * (total - done) / done)
            line = f"{what}: {done:,} of {total:,}, left {left}"
            console.print(line, highlight=False, markup=False, soft_wrap=True)

    yield update
