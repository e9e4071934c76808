"""Stopping a run cleanly on Ctrl-C (SIGINT) and SIGTERM."""

import math
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from experiments.commandline.arguments import INTERRUPTED

SIGNALS = (signal.SIGINT, signal.SIGTERM)
SAME_SIGNAL_SECONDS = 1.0


@contextmanager
def stop_on_signal() -> Iterator[list[int]]:
    """Collects SIGINT and SIGTERM in the list that it yields; a second signal ends the process at once.

    A SIGTERM within a second of another one counts as the same: with a batch system, both the system and
    `experiments.sweep`, which forwards its own, send one to this process.
    """
    received: list[int] = []
    last_sigterm = -math.inf

    def handle(number: int, _: FrameType | None) -> None:
        nonlocal last_sigterm
        if number == signal.SIGTERM:
            since, last_sigterm = time.monotonic() - last_sigterm, time.monotonic()
            if since < SAME_SIGNAL_SECONDS:
                return
        if received:
            # Not by an exception: it could be raised inside a callback of the compiled program.
            os._exit(INTERRUPTED)
        received.append(number)
        print("stopping when the running chunk of training or evaluation ends", file=sys.stderr)

    before = {number: signal.getsignal(number) for number in SIGNALS}
    for number in SIGNALS:
        signal.signal(number, handle)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
