"""Trains the cells of a grid through a launcher, retries lost ones, and lists those that failed."""

import shlex
import time
from collections.abc import Callable, Sequence

from experiments.commandline.arguments import BAD_USAGE, DIVERGED, DONE, FAILED, INTERRUPTED
from experiments.grids.finished import finished, scores
from experiments.grids.grid import needs_training
from experiments.grids.status import progress_text
from experiments.launchers.cell import INTERRUPTED_TEXT, Cell, Ended
from experiments.launchers.launcher import Launcher
from experiments.launchers.slurm import SlurmLauncher
from experiments.running.progress import format_seconds

WORST_FIRST = (INTERRUPTED, FAILED, BAD_USAGE, DIVERGED, DONE)
PROGRESS_SECONDS = 120.0


def train_cells(
    cells: Sequence[Cell],
    launcher: Launcher,
    say: Callable[[str], None],
    *,
    retries: int = 0,
    fail_fast: bool = False,
    signals: Callable[[], int] = lambda: 0,
    on_end: Callable[[Ended], None] | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> int:
    """Trains the cells that are not finished. One that fails does not stop the others.

    Args:
      launcher: starts them.
      say: called with each line to print.
      retries: how often a cell is started again that was killed or whose machine was lost.
      fail_fast: the first cell that fails stops all others, after they have saved.
      signals: how many signals have asked to stop: the first lets runs save, a second ends them at once.
      on_end: called with each cell that has ended, instead of lines with its scores.

    Returns:
      The worst exit code of the cells, the first of `WORST_FIRST`.
    """
    todo = [cell for cell in cells if needs_training(cell)]
    if on_end is None:
        say(f"{len(cells)} runs, {len(cells) - len(todo)} of them finished")
    began = said = clock()
    over: list[Ended] = []
    starts = dict.fromkeys(todo, 1)
    cancelled = 0
    with launcher:
        launcher.submit(todo)
        while len(over) < len(todo):
            failed = fail_fast and any(ended.code not in (DONE, DIVERGED) for ended in over)
            for _ in range(min(max(signals(), failed), 2) - cancelled):
                launcher.cancel()
                cancelled += 1
            for ended in launcher.ended():
                cell = ended.cell
                if ended.lost and (cancelled or signals()):  # it was asked to end before it could save
                    ended = ended._replace(code=INTERRUPTED, reason=INTERRUPTED_TEXT)
                elif ended.lost and starts[cell] <= retries:
                    say(f"{cell.label}: {ended.reason}; started again ({starts[cell]} of {retries})")
                    starts[cell] += 1
                    launcher.submit([cell])
                    continue
                over.append(ended)
                if on_end:
                    on_end(ended)
                    continue
                left = (clock() - began) / len(over) * (len(todo) - len(over))
                say(f"{len(over)}/{len(todo)} {cell.label}: {_result(ended)}; {format_seconds(left)} left")
            if clock() - said > PROGRESS_SECONDS:
                said = clock()
                not_over = set(todo) - {ended.cell for ended in over}
                for line in filter(None, (progress_text(cell) for cell in todo if cell in not_over)):
                    say(line)
    for line in _failures(over):
        say(line)
    # With `fail_fast`, the code is that of the failure, not of the runs that it stopped.
    counted = [ended for ended in over if not (fail_fast and not signals() and ended.code == INTERRUPTED)] or over
    return min((_exit_code(ended) for ended in counted), key=WORST_FIRST.index, default=DONE)


def submit_and_leave(cells: Sequence[Cell], launcher: SlurmLauncher, say: Callable[[str], None]) -> int:
    """Submits the cells that are not finished, and do not wait or run already. Returns the exit code."""
    todo = [cell for cell in cells if needs_training(cell)]
    launcher.submit(todo)
    queued = len(launcher.already_queued)
    say(f"{len(cells)} runs, {len(cells) - len(todo)} of them finished, {queued} already submitted")
    say(f"{len(todo) - queued} submitted; the same command with --status shows them")
    return DONE


def repeat_command(cell: Cell) -> str:
    """The command line that trains a cell, or resumes it."""
    return shlex.join(["python", "-m", "experiments.run", *cell.command])


def _result(ended: Ended) -> str:
    if ended.code in (DONE, DIVERGED):
        return scores(finished(ended.cell))
    return ended.reason


def _failures(over: Sequence[Ended]) -> list[str]:
    """What did not end well: cell, reason, log and the command that repeats it."""
    failed = [ended for ended in over if ended.code not in (DONE, DIVERGED)]
    if not failed:
        return []
    lines = [f"{len(failed)} of {len(over)} runs did not finish:"]
    for ended in failed:
        lines += [f"  {ended.cell.label}: {ended.reason}", f"    log: {ended.cell.log}"]
        lines += [f"    repeat: {repeat_command(ended.cell)}"]
    return lines


def _exit_code(ended: Ended) -> int:
    return ended.code if ended.code in WORST_FIRST else FAILED
