"""The first SIGINT or SIGTERM stops a run, the second one ends the process."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.running import signals

BLOCKED = """
import hashlib
from experiments.running.signals import stop_on_signal
with stop_on_signal():
    print("ready", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)  # many minutes outside of Python
"""


def test_a_second_signal_ends_a_process_that_does_not_return_from_compiled_code():
    root = str(Path(__file__).parent.parent)
    with subprocess.Popen(
        [sys.executable, "-c", BLOCKED], stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=root
    ) as process:
        assert process.stdout.readline() == b"ready\n"
        process.send_signal(signal.SIGINT)
        assert b"stopping when the running chunk" in process.stderr.readline()
        assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 130


def test_signals_are_collected_and_the_first_ends_nothing(monkeypatch):
    codes = []
    monkeypatch.setattr(signals.os, "_exit", codes.append)
    with signals.stop_on_signal() as received:
        signal.raise_signal(signal.SIGTERM)
        assert received == [signal.SIGTERM]
    assert codes == []


def test_the_second_of_sigint_and_sigterm_ends_the_process():
    requests = signals.Requests()
    found = [requests.add(number, 0.0) for number in (signal.SIGUSR1, signal.SIGTERM, signal.SIGUSR1, signal.SIGINT)]
    assert found == [False, False, False, True]


def test_a_sigterm_that_comes_twice_at_once_is_one():
    """Sent by a batch system and by `experiments.sweep`, which forwards its own."""
    requests = signals.Requests()
    assert [requests.add(signal.SIGTERM, at) for at in (100.0, 100.9, 102.0)] == [False, False, True]


def test_in_a_job_of_a_cluster_all_sigterms_are_one(monkeypatch):
    monkeypatch.setenv("SQT_JOB", "slurm 7")
    requests = signals.Requests()
    assert [requests.add(signal.SIGTERM, at) for at in (100.0, 102.0, 110.0)] == [False, False, False]
    assert requests.add(signal.SIGINT, 110.0)


def test_the_handlers_are_the_old_ones_afterwards():
    before = [signal.getsignal(number) for number in signals.SIGNALS]
    with signals.stop_on_signal():
        assert [signal.getsignal(number) for number in signals.SIGNALS] != before
    assert [signal.getsignal(number) for number in signals.SIGNALS] == before


@pytest.mark.parametrize("number", signals.ANNOUNCEMENTS)
def test_an_announced_end_stops_a_run_and_may_be_repeated(monkeypatch, number):
    """A batch system announces the end, then sends SIGTERM: the run is still saving."""
    codes = []
    monkeypatch.setattr(signals.os, "_exit", codes.append)
    monkeypatch.setattr(signals, "announcements", lambda: signals.ANNOUNCEMENTS)  # nohup around the tests ignores one
    with signals.stop_on_signal() as received:
        for sent in (number, number, signal.SIGTERM):
            signal.raise_signal(sent)
        assert received == [number, number, signal.SIGTERM]
    assert codes == []


def test_an_ignored_signal_stays_ignored():
    """By `nohup`."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with signals.stop_on_signal() as received:
            signal.raise_signal(signal.SIGHUP)
        assert received == [] and signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
