"""Scalars for TensorBoard, written by the thread that reports them.

tensorboardX's own `SummaryWriter` has a thread and a queue; a full disk ends the thread, and the queue then blocks the
run.
"""

import os
import time
from collections.abc import Mapping
from pathlib import Path

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.summary import scalar


class Events:
    """One folder of events, a new file in it.

    Args:
      purge_step: TensorBoard hides what earlier files say of this step and later ones.

    Raises:
      OSError: here and later, where nothing can be written.
    """

    def __init__(self, folder: Path, purge_step: int | None = None):
        folder.mkdir(parents=True, exist_ok=True)
        # The name has the time in seconds: two processes may begin in one.
        self._writer = EventsWriter(str(folder / "events"), f".{os.getpid()}")
        if purge_step is not None:
            self._writer.write_event(Event(step=purge_step, session_log=SessionLog(status=SessionLog.START)))
        self._writer.flush()

    def add(self, values: Mapping[str, float], step: int) -> None:
        for name, value in values.items():
            self._writer.write_event(Event(wall_time=time.time(), step=step, summary=scalar(name, value)))
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()
