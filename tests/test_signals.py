"""The first SIGINT or SIGTERM stops a run, the second one ends the process."""

import signal

import pytest

from experiments.running import signals


def test_a_second_signal_ends_the_process_at_once(monkeypatch):
    codes = []
    monkeypatch.setattr(signals.os, "_exit", codes.append)
    with signals.stop_on_signal() as received:
        signal.raise_signal(signal.SIGTERM)
        assert received == [signal.SIGTERM] and codes == []
        signal.raise_signal(signal.SIGINT)
        assert codes == [130]


def test_a_sigterm_that_comes_twice_at_once_is_one(monkeypatch):
    """Sent by a batch system and by `experiments.sweep`, which forwards its own."""
    codes, now = [], []
    monkeypatch.setattr(signals.os, "_exit", codes.append)
    monkeypatch.setattr(signals.time, "monotonic", lambda: now[-1])
    with signals.stop_on_signal() as received:
        for at, left in [(100.0, []), (100.9, []), (102.0, [130])]:
            now.append(at)
            signal.raise_signal(signal.SIGTERM)
            assert received[0] == signal.SIGTERM and codes == left


def test_in_a_job_of_a_cluster_all_sigterms_are_one(monkeypatch):
    """SLURM's scancel may send one again after seconds, while the run still saves."""
    codes, now = [], []
    monkeypatch.setenv("SQT_JOB", "slurm 1_0")
    monkeypatch.setattr(signals.os, "_exit", codes.append)
    monkeypatch.setattr(signals.time, "monotonic", lambda: now[-1])
    with signals.stop_on_signal() as received:
        for at in (100.0, 105.0, 160.0):
            now.append(at)
            signal.raise_signal(signal.SIGTERM)
        assert received == [signal.SIGTERM] and codes == []


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
        assert received == [number, number, signal.SIGTERM] and codes == []


def test_an_ignored_signal_stays_ignored():
    """By `nohup`."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with signals.stop_on_signal() as received:
            signal.raise_signal(signal.SIGHUP)
        assert received == [] and signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
