"""Signals that ask a sweep to stop."""

import os
import signal

from experiments.grids import stopping
from experiments.grids.stopping import collected_signals


def send(number):
    os.kill(os.getpid(), number)


def test_ctrl_c_counts_each_time_and_says_so_once(capfd):
    before = signal.getsignal(signal.SIGINT)
    with collected_signals() as received:
        send(signal.SIGINT)
        send(signal.SIGINT)
    assert received == [signal.SIGINT, signal.SIGINT] and signal.getsignal(signal.SIGINT) == before
    assert capfd.readouterr().err == "stopping: running runs save and end; a second signal ends them at once\n"


def test_sigterms_at_once_and_announcements_count_once(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(stopping.time, "monotonic", lambda: now[0])
    with collected_signals() as received:
        send(signal.SIGTERM)
        send(signal.SIGTERM)
        send(signal.SIGUSR2)
        assert received == [signal.SIGTERM]
        now[0] += 2
        send(signal.SIGTERM)
    assert received == [signal.SIGTERM, signal.SIGTERM]
    with collected_signals() as received:
        send(signal.SIGUSR1)
        send(signal.SIGUSR2)
    assert received == [signal.SIGUSR1]
