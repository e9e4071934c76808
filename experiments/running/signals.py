"""Stopping a run cleanly: on Ctrl-C (SIGINT), SIGTERM, and the signals by which a system announces an end."""

import math
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from experiments.commandline.arguments import INTERRUPTED

SIGNALS = (signal.SIGINT, signal.SIGTERM)
# A terminal that closes; what batch systems send before a time limit (SLURM's --signal); a limit of CPU time.
ANNOUNCEMENTS = (signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU)
SAME_SIGNAL_SECONDS = 1.0


def announcements() -> list[signal.Signals]:
    """`ANNOUNCEMENTS` without those that are ignored, as SIGHUP is under `nohup`."""
    return [number for number in ANNOUNCEMENTS if signal.getsignal(number) != signal.SIG_IGN]


@contextmanager
def stop_on_signal() -> Iterator[list[int]]:
    """Collects the signals in the list that it yields; a second SIGINT or SIGTERM ends the process at once.

    A SIGTERM within a second of another one counts as the same: with a batch system, both the system and
    `experiments.sweep`, which forwards its own, send one to this process. In a job that a launcher started on a
    cluster (the variable SQT_JOB), all SIGTERMs do: SLURM's scancel may repeat one. An announcement that is ignored
    stays so (`nohup`).
    """
    received: list[int] = []
    last_sigterm = -math.inf
    same_seconds = math.inf if "SQT_JOB" in os.environ else SAME_SIGNAL_SECONDS

    def handle(number: int, _: FrameType | None) -> None:
        nonlocal last_sigterm
        if number == signal.SIGTERM:
            since, last_sigterm = time.monotonic() - last_sigterm, time.monotonic()
            if since < same_seconds:
                return
        if number in SIGNALS and any(earlier in SIGNALS for earlier in received):
            # Not by an exception: it could be raised inside a callback of the compiled program.
            os._exit(INTERRUPTED)
        if not received:
            # Not by print, which may be the very call that is interrupted.
            with suppress(OSError):
                os.write(2, b"stopping when the running chunk of training or evaluation ends\n")
        received.append(number)

    handled = [*SIGNALS, *announcements()]
    if threading.current_thread() is not threading.main_thread():
        handled = []  # Python allows handlers in the main thread only: signals are its caller's
    before = {number: signal.signal(number, handle) for number in handled}
    try:
        yield received
    finally:
        for number, handler in before.items():
            if handler is not None:  # it was not installed from Python
                signal.signal(number, handler)
