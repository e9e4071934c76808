"""A process that dies with this one, and talks to it by JSON objects, one a line, on its input and output."""

import json
import os
import queue
import re
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from experiments.commandline.arguments import printable
from experiments.launchers import tied

MAX_TEXT = 300
LOG_PREFIX = re.compile(r"^\[[^\]]*\] \S+:\d+: ")  # of a line of a C++ log: time, process, file and line


class MessageProcess:
    """The process. A terminal's signals do not reach it. Leaving the context closes its input and waits for its end.

    Args:
      command: with its arguments.
      variables: added to its environment.
      leave_seconds: how long it may take to end; then it is killed.
    """

    def __init__(self, command: Sequence[str], variables: Mapping[str, str], leave_seconds: float = 30.0):
        self._leave_seconds = leave_seconds
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  closed by the context
        self._inbox: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._process = subprocess.Popen(
            [sys.executable, tied.__file__, str(os.getpid()), "all", *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            start_new_session=True,
            env=os.environ | variables,
        )
        threading.Thread(target=self._read, daemon=True).start()

    def send(self, **message: Any) -> None:
        """Sends a message, if the process has not ended."""
        assert self._process.stdin
        with suppress(OSError):
            self._process.stdin.write((json.dumps(message) + "\n").encode())
            self._process.stdin.flush()

    def receive(self, seconds: float) -> dict[str, Any] | None:
        """Its next message; None after its end.

        Raises:
          queue.Empty: none has come within `seconds`.
        """
        return self._inbox.get(timeout=seconds) if seconds else self._inbox.get_nowait()

    def errors(self) -> str:
        """What it has written to its standard error."""
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace")

    def last_error(self) -> str:
        """The first sentence of the last line that it wrote to its standard error."""
        lines = self.errors().strip().splitlines()
        line = LOG_PREFIX.sub("", lines[-1].strip()).partition(". ")[0] if lines else "its process was killed"
        return printable(line)[:MAX_TEXT]

    def kill(self) -> None:
        """Ends it at once."""
        self._process.kill()
        self._process.wait()

    def _read(self) -> None:
        assert self._process.stdout
        for line in self._process.stdout:
            self._inbox.put(json.loads(line))
        self._inbox.put(None)

    def __enter__(self) -> "MessageProcess":
        return self

    def __exit__(self, *error: object) -> None:
        assert self._process.stdin
        with suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(self._leave_seconds)
        except subprocess.TimeoutExpired:
            self.kill()
        self._errors.close()
