"""Stopping a run cleanly: on Ctrl-C (SIGINT), SIGTERM, and the signals by which a system announces an end."""

import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

from experiments.commandline.arguments import INTERRUPTED

SIGNALS = (signal.SIGINT, signal.SIGTERM)
# A terminal that closes; what batch systems send before a time limit (SLURM's --signal); a limit of CPU time.
ANNOUNCEMENTS = (signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU)
SAME_SIGNAL_SECONDS = 1.0


def announcements() -> list[signal.Signals]:
    """`ANNOUNCEMENTS` without those that are ignored, as SIGHUP is under `nohup`."""
    return [number for number in ANNOUNCEMENTS if signal.getsignal(number) != signal.SIG_IGN]


class Requests:
    """The signals that have asked to stop.

    A SIGTERM within a second of another one counts as the same: with a batch system, both the system and
    `experiments.sweep`, which forwards its own, send one to this process. In a job that a launcher started on a
    cluster (the variable SQT_JOB), all SIGTERMs do: SLURM's scancel may repeat one.
    """

    def __init__(self) -> None:
        self.same_seconds = math.inf if "SQT_JOB" in os.environ else SAME_SIGNAL_SECONDS
        self.last_sigterm = -math.inf
        self.received: list[int] = []

    def add(self, number: int, now: float) -> bool:
        """Whether the signal `number` at the time `now`, in seconds, is the second SIGINT or SIGTERM."""
        if number == signal.SIGTERM:
            since, self.last_sigterm = now - self.last_sigterm, now
            if since < self.same_seconds:
                return False
        second = number in SIGNALS and any(earlier in SIGNALS for earlier in self.received)
        self.received.append(number)
        return second


@contextmanager
def handling(numbers: Sequence[int], handle: Callable[[int], None]) -> Iterator[None]:
    """Calls `handle` with the number of each of these signals; afterwards the handlers are the old ones."""
    before = {number: signal.signal(number, lambda number, _: handle(number)) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:  # it was not installed from Python
                signal.signal(number, handler)


@contextmanager
def stop_on_signal() -> Iterator[list[int]]:
    """Collects the signals in the list that it yields; a second SIGINT or SIGTERM ends the process at once.

    An announcement that is ignored stays so (`nohup`). Python calls handlers when the main thread is back from the
    compiled program. A thread sees the second signal earlier: an environment may never return.
    """
    if threading.current_thread() is not threading.main_thread():
        yield []  # Python allows handlers in the main thread only: signals are its caller's
        return
    received: list[int] = []
    handled = [*SIGNALS, *announcements()]
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    watcher = threading.Thread(target=_watch, args=(reader, handled), daemon=True, name="signals")
    watcher.start()
    before_fd = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)  # gets the number of each signal as a byte
    try:
        with handling(handled, received.append):
            yield received
    finally:
        signal.set_wakeup_fd(before_fd)
        os.close(writer)
        watcher.join()


def _watch(reader: int, handled: Sequence[int]) -> None:
    """Reads the numbers of signals until the other end is closed, and ends the process at the second request."""
    requests = Requests()
    while numbers := os.read(reader, 100):
        for number in filter(handled.__contains__, numbers):
            if not requests.received:
                with suppress(OSError):
                    os.write(2, b"stopping when the running chunk of training or evaluation ends\n")
            if requests.add(number, time.monotonic()):
                # Not by an exception: it could be raised inside a callback of the compiled program.
                os._exit(INTERRUPTED)
    os.close(reader)
