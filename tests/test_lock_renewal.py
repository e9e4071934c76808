"""Keeping the record of a lock alive."""

import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from experiments.running import lock_record, lock_renewal

BEAT = 0.02


@pytest.fixture
def lock(tmp_path):
    """A file `lock` with the record of this process."""
    own = lock_record.new_record("here")
    (tmp_path / "lock").write_bytes(lock_record.encode(own))
    return tmp_path / "lock", own


def renewed(lock, warn=pytest.fail, lost=pytest.fail, first=0.0):
    return lock_renewal.renewed(*lock, first, BEAT, warn, lost)


def wait_for(condition):
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(BEAT / 4)


def record(lock):
    return lock_record.decode(lock[0].read_bytes())


def test_a_record_is_rewritten_and_released(lock):
    path, own = lock
    with renewed(lock):
        wait_for(lambda: record(lock).beat >= 3)
        assert record(lock) == own._replace(beat=record(lock).beat)
    assert record(lock) == own._replace(released=True)
    assert path.stat().st_size == lock_record.RECORD_BYTES


def test_the_first_look_has_its_own_time(lock):
    with renewed(lock, first=100):
        time.sleep(3 * BEAT)
        assert record(lock).beat == 0


def test_a_record_of_another_process_stays_and_is_reported_once(lock):
    path, _ = lock
    other, lines = lock_record.new_record("there", {"SQT_JOB": "j"}), []
    with renewed(lock, lost=lines.append):
        path.write_bytes(lock_record.encode(other))
        wait_for(lambda: lines)
        time.sleep(3 * BEAT)
    assert record(lock) == other
    assert lines == [f"{path.parent}: {other} has taken over this run; this process ends"]


@pytest.mark.parametrize("content", [b"", b"123\n", b"x" * 5000])
def test_damage_is_repaired(lock, content):
    with renewed(lock):
        lock[0].write_bytes(content)
        wait_for(lambda: b'"beat"' in lock[0].read_bytes()[: lock_record.RECORD_BYTES])


def test_a_failure_to_write_costs_one_warning(lock):
    path, own = lock
    lines = []
    with renewed(lock, warn=lines.append):
        path.unlink()
        wait_for(lambda: lines)
        time.sleep(3 * BEAT)
        path.write_bytes(lock_record.encode(own))
        wait_for(lambda: record(lock).beat > 0)  # it goes on
    assert len(lines) == 1 and lines[0].startswith(f"{path} cannot be renewed (") and "No such file" in lines[0]


def test_a_warning_that_cannot_be_printed_does_not_stop_the_renewal(lock):
    path, own = lock
    called = []

    def closed(line):
        called.append(line)
        raise ValueError("I/O operation on closed file")

    with renewed(lock, warn=closed):
        path.unlink()
        wait_for(lambda: called)
        path.write_bytes(lock_record.encode(own))
        wait_for(lambda: record(lock).beat > 0)


def test_a_system_without_more_threads_costs_a_warning(lock, monkeypatch):
    def refuse(thread):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    lines = []
    with renewed(lock, warn=lines.append):
        assert record(lock).beat == 0
    assert len(lines) == 1 and "can't start new thread" in lines[0]
    assert record(lock).released


END = """
from experiments.running import lock_renewal
try:
    lock_renewal.end_process("a\\x1b \\u00e9")
finally:
    print("tidied up")
"""


def test_a_process_ends_with_one_line_and_130():
    root = Path(__file__).resolve().parent.parent
    done = subprocess.run([sys.executable, "-c", END], cwd=root, capture_output=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, b"", b"a\\x1b \\xe9\n")
