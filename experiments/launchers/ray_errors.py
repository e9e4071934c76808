"""Ray's exceptions in this repository's words."""

import re

from ray import exceptions

from experiments.commandline.arguments import FAILED, INTERRUPTED, printable
from experiments.launchers.cell import Cell, Ended

MAX_TEXT = 300


class ClusterLost(Exception):
    """The cluster is gone, or this machine's part of it. The text says why."""


def ended_by(error: Exception, cell: Cell, forced: bool = False) -> Ended:
    """How a cell ended whose task raised an exception in place of a result.

    Args:
      forced: whether running tasks were cancelled by killing their workers.

    Raises:
      ClusterLost: no other task will have a result either.
    """
    if isinstance(error, exceptions.LocalRayletDiedError | exceptions.RaySystemError):
        raise ClusterLost(one_line(error)) from error
    if isinstance(error, exceptions.TaskCancelledError):
        return Ended(cell, FAILED, "killed", lost=True) if forced else Ended(cell, INTERRUPTED, "not started")
    if isinstance(error, exceptions.WorkerCrashedError):
        return Ended(cell, FAILED, "its Ray worker died", lost=True)
    if isinstance(error, exceptions.NodeDiedError):
        found = re.search(r"Node IP: ([^\s,]+)", str(error))
        return Ended(cell, FAILED, f"its Ray node{f' {found[1]}' if found else ''} is gone", lost=True)
    if isinstance(error, exceptions.OutOfMemoryError):
        return Ended(cell, FAILED, "ended by Ray: the memory of its node is full", lost=True)
    # A task's own exception, such as a log that cannot be written, comes again; Ray's others are of its machinery.
    return Ended(cell, FAILED, one_line(error), lost=not isinstance(error, exceptions.RayTaskError))


def one_line(error: BaseException) -> str:
    """The message of an exception; of one with a traceback in it, its last line."""
    text = str(error).strip() or type(error).__name__
    text = text.splitlines()[-1] if isinstance(error, exceptions.RayTaskError) else " ".join(text.split())
    return printable(text)[:MAX_TEXT]
