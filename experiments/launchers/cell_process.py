"""The process that trains a cell: `experiments.run`, its log, and how it ended."""

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress

from experiments.commandline.arguments import BAD_USAGE, DIVERGED, DONE, FAILED, INTERRUPTED, printable
from experiments.launchers import tied
from experiments.launchers.cell import INTERRUPTED_TEXT, Cell, Ended, write_ended
from experiments.running import folder_lock

TAIL_BYTES = 10_000
MAX_REASON = 500
WORDS = {INTERRUPTED: INTERRUPTED_TEXT, DONE: "", DIVERGED: ""}


class CellProcess:
    """`experiments.run` on a cell, in a process that dies with this one, and not by the terminal's Ctrl-C.

    Args:
      cores: those it may use; empty: all of this process's.
      variables: added to its environment.

    Raises:
      OSError: the log cannot be written.
    """

    def __init__(self, cell: Cell, cores: Sequence[int] = (), variables: Mapping[str, str] | None = None):
        self.cell = cell
        cell.path.parent.mkdir(parents=True, exist_ok=True)
        cell.ended_file.unlink(missing_ok=True)
        command = [sys.executable, tied.__file__, str(os.getpid()), ",".join(map(str, cores)) or "all"]
        command += [sys.executable, "-m", "experiments.run", *cell.command]
        with cell.log.open("ab") as log:
            self._began = log.tell()
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches the launcher, which forwards it once
                env=os.environ | (variables or {}),
            )

    def send_signal(self, number: int) -> None:
        """Sends a signal to the process, if it has not ended."""
        self._process.send_signal(number)

    def wait(self, seconds: float | None = None) -> Ended | None:
        """How the process ended; None if it still runs after `seconds`. None waits for its end."""
        try:
            code = self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None
        ended = self._explained(code)
        if not self._is_of_another(ended):
            with suppress(OSError):  # a full disk: only --status misses it
                write_ended(ended)
        return ended

    def _is_of_another(self, ended: Ended) -> bool:
        """Whether the run was refused while another process trains it: the file would be about that one's run."""
        holder = folder_lock.holder(self.cell.path) if ended.code == BAD_USAGE else None
        return bool(holder and holder.alive)

    def _explained(self, code: int) -> Ended:
        if code < 0:
            return Ended(self.cell, FAILED, f"killed by {_signal_name(-code)}", lost=True)
        reason = WORDS.get(code)
        return Ended(self.cell, code, self._last_line() if reason is None else reason)

    def _last_line(self) -> str:
        """The last line that this process printed: of a run that failed, its error."""
        try:
            with self.cell.log.open("rb") as log:
                log.seek(0, os.SEEK_END)
                log.seek(max(self._began, log.tell() - TAIL_BYTES))
                lines = log.read().decode(errors="replace").strip().splitlines()
        except OSError as error:
            return f"its log cannot be read: {printable(str(error))}"[:MAX_REASON]
        return printable(lines[-1].strip())[:MAX_REASON] if lines else "it printed nothing"


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
