"""Signals that ask a sweep to stop: the first lets its runs save, the second ends them at once."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from experiments.running.signals import SAME_SIGNAL_SECONDS, SIGNALS, announcements


@contextmanager
def collected_signals() -> Iterator[list[int]]:
    """Collects the signals that ask to stop in the list that it yields.

    SIGTERMs within a second count as one: a batch system and a shell that it ends may both send one. Announcements
    count once.
    """
    received: list[int] = []
    last_sigterm = -SAME_SIGNAL_SECONDS

    def handle(number: int, _: FrameType | None) -> None:
        nonlocal last_sigterm
        if number == signal.SIGTERM:
            since, last_sigterm = time.monotonic() - last_sigterm, time.monotonic()
            if since < SAME_SIGNAL_SECONDS:
                return
        if received and number not in SIGNALS:
            return
        if not received:
            with suppress(OSError):  # not by print, which may be the very call that is interrupted
                os.write(2, b"stopping: running runs save and end; a second signal ends them at once\n")
        received.append(number)

    before = {number: signal.signal(number, handle) for number in (*SIGNALS, *announcements())}
    try:
        yield received
    finally:
        for number, handler in before.items():
            if handler is not None:  # it was not installed from Python
                signal.signal(number, handler)
