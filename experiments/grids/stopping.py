"""Signals that ask a sweep to stop: the first lets its runs save, the second ends them at once."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from experiments.running.signals import SIGNALS, Requests, announcements, handling


@contextmanager
def collected_signals() -> Iterator[list[int]]:
    """Collects the signals that ask to stop in the list that it yields.

    SIGTERMs count as in `Requests`. Announcements count once.
    """
    requests = Requests()

    def handle(number: int) -> None:
        first = not requests.received
        if first or number in SIGNALS:
            requests.add(number, time.monotonic())
        if first:
            with suppress(OSError):  # not by print, which may be the very call that is interrupted
                os.write(2, b"stopping: running runs save and end; a second signal ends them at once\n")

    with handling((*SIGNALS, *announcements()), handle):
        yield requests.received
