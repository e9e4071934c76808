"""Scalars for TensorBoard, written in the calling thread.

tensorboardX's own `SummaryWriter` writes from a queue in a thread. A full disk ends the thread, and the full queue then
blocks the run.
"""

import os
import time
from collections.abc import Mapping
from pathlib import Path

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.summary import scalar


class Events:
    """A new event file in a folder.

    Args:
      purge_step: TensorBoard ignores events of earlier files from this step on.

    Raises:
      OSError: here and in `add`, if nothing can be written.
    """

    def __init__(self, folder: Path, purge_step: int | None = None):
        folder.mkdir(parents=True, exist_ok=True)
        # The file name has the time in seconds, in which two processes may start.
        self._writer = EventsWriter(str(folder / "events"), f".{os.getpid()}")
        if purge_step is not None:
            self._writer.write_event(Event(step=purge_step, session_log=SessionLog(status=SessionLog.START)))
        self._writer.flush()

    def add(self, values: Mapping[str, float], step: int) -> None:
        """Writes a scalar event per name."""
        for name, value in values.items():
            self._writer.write_event(Event(wall_time=time.time(), step=step, summary=scalar(name, value)))
        self._writer.flush()

    def close(self) -> None:
        """Closes the file."""
        self._writer.close()
