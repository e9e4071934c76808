"""Where the batches of a round are trained, and the launcher that all rounds of a tuning share."""

from collections.abc import Sequence
from typing import NamedTuple

from experiments.launchers.cell import Cell, Ended
from experiments.launchers.choice import LauncherOptions, make_launcher
from experiments.launchers.launcher import Launcher


class Rounds(NamedTuple):
    """How rounds are trained."""

    launcher: Launcher  # of all rounds
    workers: int  # batches that are asked for and trained side by side
    workers_here: int  # those of them that share this machine's memory; 0: they are trained on a cluster


def make_rounds(given: LauncherOptions) -> Rounds:
    """The rounds of `--launcher` and `--workers`. Raises `UsageError` as `make_launcher`."""
    workers = given.workers or 1
    if given.launcher == "local":
        return Rounds(make_launcher(given), workers, workers)
    # On a cluster --workers is the size of a round only: the launcher has no such limit.
    return Rounds(make_launcher(given._replace(workers=None)), workers, 0)


class OpenLauncher:
    """A launcher that stays open when a round leaves it, for the next one. Whoever opened it closes it.

    Each round would else start a cluster of its own with `--launcher=ray`.
    """

    def __init__(self, launcher: Launcher):
        self._launcher = launcher

    def submit(self, cells: Sequence[Cell]) -> None:
        """As `Launcher.submit`."""
        self._launcher.submit(cells)

    def ended(self) -> list[Ended]:
        """As `Launcher.ended`."""
        return self._launcher.ended()

    def cancel(self) -> None:
        """As `Launcher.cancel`."""
        self._launcher.cancel()

    def __enter__(self) -> "OpenLauncher":
        return self

    def __exit__(self, *error: object) -> None:
        pass
