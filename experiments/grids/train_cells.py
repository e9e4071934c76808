"""Trains the cells of a grid one after another, each in a process of its own."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any

from experiments.commandline.arguments import BAD_USAGE, DIVERGED, DONE, FAILED, INTERRUPTED
from experiments.grids.grid import GridCell, finished, needs_training
from experiments.running.progress import format_seconds
from experiments.running.signals import announcements


def train_in_process(cell: GridCell) -> int:
    """Trains a cell by `experiments.run` and returns its exit code.

    Its output goes to a file NAME.log.txt next to the run's folder; errors are also printed. SIGINT, SIGTERM and the
    signals that announce an end reach the run, which then saves a checkpoint.
    """
    cell.path.parent.mkdir(parents=True, exist_ok=True)
    with (cell.path.parent / f"{cell.path.name[:100]}.log.txt").open("a") as log:
        command = [sys.executable, "-m", "experiments.run", *cell.command]
        process: subprocess.Popen[str] | None = None
        stopped = False

        def forward(number: int, _: FrameType | None) -> None:
            nonlocal stopped
            stopped = True
            if process:
                process.send_signal(number)

        before = {number: signal.signal(number, forward) for number in (signal.SIGTERM, *announcements())}
        try:
            process = subprocess.Popen(command, stdout=log, stderr=subprocess.PIPE, text=True, errors="replace")
            if stopped:  # before the process existed
                process.terminate()
            while True:
                try:
                    _, errors = process.communicate()
                    break
                except KeyboardInterrupt:  # Ctrl-C reaches the run too
                    stopped = True
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
    code = process.returncode
    if stopped and code not in (FAILED, BAD_USAGE):  # also if the run had just ended or just started
        return INTERRUPTED
    if code not in (DONE, DIVERGED, INTERRUPTED) and errors.strip():
        print(errors.strip(), file=sys.stderr)
    return code


def train_cells(
    cells: Sequence[GridCell],
    train: Callable[[GridCell], int],
    say: Callable[[str], None],
    clock: Callable[[], float] = time.monotonic,
) -> int:
    """Trains the cells that are not finished, up to the first one that fails or is interrupted.

    Args:
      train: trains a cell and returns the exit code of its run.
      say: called with each line to print.

    Returns:
      That cell's exit code; else `DIVERGED` if a member diverged; else `DONE`.
    """
    todo = [cell for cell in cells if needs_training(cell)]
    say(f"{len(cells)} runs, {len(cells) - len(todo)} of them finished")
    began, worst = clock(), DONE
    for number, cell in enumerate(todo, start=1):
        started = clock()
        code = train(cell)
        if code not in (DONE, DIVERGED):
            hint = "" if code == BAD_USAGE else "; the same command resumes it"
            say(f"{cell.algo} on {cell.task}: ended with exit code {code}{hint}")
            return code
        worst = max(worst, code)
        left = (clock() - began) / number * (len(todo) - number)
        say(
            f"{number}/{len(todo)} {cell.algo} on {cell.task}: {_scores(finished(cell))} in "
            f"{format_seconds(clock() - started)}; {format_seconds(left)} left"
        )
    return worst


def _scores(summary: dict[str, Any] | None) -> str:
    """The scores in a run's summary.json, as text."""
    if summary is None:
        return "no summary"
    scores = [group["score"] for group in summary["groups"]]
    parts = ["none" if s["mean"] is None else f"{s['mean']:,.0f} +- {s['std']:,.0f}" for s in scores]
    lost = len(summary["diverged"])
    return f"score {', '.join(parts)}" + (f" ({lost} diverged)" if lost else "")
