"""A cell: one run of `experiments.run` that a launcher starts, and the files next to the run's folder about it."""

import hashlib
import json
import os
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from experiments.running import files

MAX_STEM = 100  # bytes of a run's name in the names of these files
MAX_BYTES = 100_000
INTERRUPTED_TEXT = "interrupted; the same command resumes it"  # the reason of a run that has saved and ended


class Cell(NamedTuple):
    """One run of a grid: an algorithm on a task, with its seeds."""

    task: str
    algo: str
    path: Path  # the run's folder
    command: tuple[str, ...]  # arguments of experiments.run; they have --resume
    detail: str = ""  # what tells it from the grid's other cells of this algorithm and task

    @property
    def label(self) -> str:
        """For messages."""
        return f"{self.algo} on {self.task}" + (f", {self.detail}" if self.detail else "")

    @property
    def log(self) -> Path:
        """The file with all that its processes print."""
        return self._beside(".log.txt")

    @property
    def ended_file(self) -> Path:
        """The file that says how its last process ended."""
        return self._beside(".ended.json")

    @property
    def job_file(self) -> Path:
        """The file that says which job of a batch system trains it."""
        return self._beside(".job.json")

    def _beside(self, ending: str) -> Path:
        name = self.path.name
        if len(os.fsencode(name)) > MAX_STEM:
            digest = hashlib.sha256(os.fsencode(name)).hexdigest()[:12]
            name = f"{os.fsdecode(os.fsencode(name)[: MAX_STEM - 13])}_{digest}"
        return self.path.parent / f"{name}{ending}"


class Ended(NamedTuple):
    """How a cell's process ended."""

    cell: Cell
    code: int  # of `experiments.run`; FAILED if it has none
    reason: str  # one line, empty if the run is done
    lost: bool = False  # killed, or its machine is gone: the same command resumes it


def write_ended(ended: Ended) -> None:
    """Writes the cell's `ended_file`. Raises `OSError`."""
    content = {"code": ended.code, "reason": ended.reason, "lost": ended.lost, "host": platform.node()}
    content |= {"at": datetime.now(UTC).isoformat(timespec="seconds")}
    with files.atomic_file(ended.cell.ended_file) as file:
        file.write((json.dumps(content) + "\n").encode())


def read_ended(cell: Cell) -> Ended | None:
    """The content of the cell's `ended_file`; None if there is none that can be read."""
    try:
        content = files.read_json(cell.ended_file, MAX_BYTES)
        code, reason, lost = content["code"], content["reason"], content["lost"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if type(code) is not int or not isinstance(reason, str) or type(lost) is not bool:
        return None
    return Ended(cell, code, reason, lost)
