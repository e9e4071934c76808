"""The lock of a run's folder, with processes of one host and of hosts that flock does not connect."""

import errno
import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from test_lock_record import DAMAGED

from experiments.launchers import ray_options
from experiments.running import files, folder_lock, lock_record
from experiments.running.folder_lock import Busy, Timing, locked

JOB = ray_options.job_name("f00d", 7)  # as two starts of a cell have it
FOREVER = 100.0  # a test that waited for it would be noticed

HOLD = """
import errno, fcntl, pathlib, sys
from experiments.running import folder_lock
folder, host, flock, expires = sys.argv[1:]
def local(descriptor, operation):  # reaches no other process
    pass
if flock == "local":
    fcntl.flock = local
timing = folder_lock.Timing(beat=0.1, expires=float(expires), settle=0.1)
sys.stdin.readline()
try:
    with folder_lock.locked(pathlib.Path(folder), host=host or None, timing=timing):
        print("locked", flush=True)
        sys.stdin.read()
except folder_lock.Busy as busy:
    print(f"busy: {busy}", flush=True)
"""


@pytest.fixture(autouse=True)
def no_job(monkeypatch):
    for name in ("SQT_JOB", "SLURM_JOB_ID", "SLURM_ARRAY_JOB_ID"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def start(tmp_path):
    """Starts processes that lock the folder `run` after a line on stdin, and then print "locked" or "busy: ..."."""
    processes = []

    def start_one(host="", flock="real", expires=FOREVER, **variables):
        pipe, root = subprocess.PIPE, Path(__file__).resolve().parent.parent
        command = [sys.executable, "-c", HOLD, str(tmp_path / "run"), host, flock, str(expires)]
        process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, cwd=root, env=os.environ | variables
        )
        processes.append(process)
        return process

    yield start_one
    for process in processes:
        with process:  # closes its streams
            process.kill()


@pytest.fixture
def hold(start):
    """Starts a process that has locked the folder `run`."""

    def hold_one(*arguments, **settings):
        process = start(*arguments, **settings)
        go(process)
        assert process.stdout.readline() == "locked\n"
        return process

    return hold_one


def go(process):
    process.stdin.write("\n")
    process.stdin.flush()


def kill(process):
    process.kill()  # SIGKILL: it has no time to tidy up
    process.wait()


@pytest.fixture
def local_flock(monkeypatch):
    """flock succeeds and reaches no other process, as on a file system that is mounted with local locks."""
    monkeypatch.setattr(fcntl, "flock", lambda descriptor, operation: None)


def record(folder):
    return lock_record.decode((folder / "lock").read_bytes())


# One host


def test_a_killed_process_keeps_nobody_out_on_its_host(tmp_path, hold):
    process = hold()
    with pytest.raises(Busy) as busy, locked(tmp_path / "run"):
        pass
    assert busy.value.holder.process == process.pid
    assert str(busy.value) == f"host {busy.value.holder.host}, process {process.pid}"
    assert record(tmp_path / "run").token == busy.value.holder.token  # it keeps the lock
    kill(process)
    began = time.monotonic()
    with locked(tmp_path / "run", pytest.fail, timing=Timing(FOREVER, FOREVER, FOREVER, FOREVER)):
        assert record(tmp_path / "run").process == os.getpid()
    assert time.monotonic() - began < 10


def test_a_lock_is_released(tmp_path):
    with pytest.raises(KeyError), locked(tmp_path):
        with pytest.raises(Busy), locked(tmp_path):  # not twice in one process either
            pass
        raise KeyError
    assert record(tmp_path).released
    # At once on any host.
    with locked(tmp_path, pytest.fail, host="other"):
        assert not record(tmp_path).released


def test_another_error_of_a_lock_is_raised(tmp_path, monkeypatch):
    def refuse(*arguments):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(OSError, match="Input/output"), locked(tmp_path / "run"):
        pass


def test_a_lock_that_is_not_a_file_is_not_written(tmp_path):
    for name in ("link", "fifo", "folder"):
        (tmp_path / name).mkdir()
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "link" / "lock").symlink_to(tmp_path / "mine")
    os.mkfifo(tmp_path / "fifo" / "lock")
    (tmp_path / "folder" / "lock").mkdir()
    for name in ("link", "fifo", "folder"):
        with pytest.raises(OSError), locked(tmp_path / name):
            pass
    assert (tmp_path / "mine").read_text() == "mine"


@pytest.mark.parametrize("number", files.NOT_SUPPORTED)
def test_without_flock_the_record_locks(tmp_path, monkeypatch, number):
    def refuse(*arguments):
        raise OSError(number, "not supported")

    monkeypatch.setattr(fcntl, "flock", refuse)
    monkeypatch.setattr(os, "fsync", refuse)
    lines = []
    timing = Timing(beat=0.02, expires=3, settle=0.02)
    with locked(tmp_path, lines.append, timing=timing):
        assert len(lines) == 1 and "has no locks (not supported)" in lines[0]
        with pytest.raises(Busy, match=f"process {os.getpid()}"), locked(tmp_path, timing=timing):
            pass
    with locked(tmp_path, timing=timing):
        pass


# Hosts that flock does not connect


def test_a_process_that_lives_on_another_host_keeps_others_out(tmp_path, hold, local_flock):
    process = hold("b", "local", SQT_JOB=JOB)
    lines = []
    with pytest.raises(Busy) as busy, locked(tmp_path / "run", lines.append, host="a", timing=Timing(expires=5)):
        pass
    assert str(busy.value) == f"host b, process {process.pid}, job {JOB}"
    assert len(lines) == 1 and f"{busy.value}, which the system's locks may not reach" in lines[0]


def test_a_process_that_died_on_another_host_is_succeeded(tmp_path, hold):
    kill(hold("b"))
    lines = []
    began = time.monotonic()
    with locked(tmp_path / "run", lines.append, host="a", timing=Timing(0.1, 0.5, FOREVER, 0.1)):
        assert record(tmp_path / "run").host == "a"
    assert time.monotonic() - began >= 0.5 + 0.1 + 0.1  # watched, then looked again
    assert len(lines) == 1 and "waiting 0.5 s" in lines[0]


def test_a_process_that_releases_its_lock_meanwhile_is_succeeded(tmp_path, hold, local_flock):
    process = hold("b", "local")
    process.send_signal(signal.SIGSTOP)  # no beat, only the release

    def release(line):
        process.stdin.close()
        process.send_signal(signal.SIGCONT)
        process.wait()

    # The record is read before the warning: what is seen next is the release.
    with locked(tmp_path / "run", release, host="a", timing=Timing(0.1, 5, FOREVER, 0.1)):
        assert record(tmp_path / "run").host == "a"


def test_a_holder_that_was_succeeded_ends(tmp_path, hold, local_flock):
    process = hold("b", "local")
    process.send_signal(signal.SIGSTOP)
    with locked(tmp_path / "run", host="a", timing=Timing(0.1, 0.5, FOREVER, 0.1), lost=pytest.fail):
        process.send_signal(signal.SIGCONT)
        assert process.wait(timeout=60) == 130
        out, err = process.communicate()
        taker = f"host a, process {os.getpid()}"
        assert (out, err) == ("", f"{tmp_path / 'run'}: {taker} has taken over this run; this process ends\n")
        assert record(tmp_path / "run").host == "a"


@pytest.mark.parametrize("content", [b"12345\n", b"\0", b"x" * 5000, *DAMAGED[-2:]])
def test_a_damaged_record_is_watched_first(tmp_path, content):
    (tmp_path / "lock").write_bytes(content)
    lines = []
    with locked(tmp_path, lines.append, timing=Timing(0.02, 0.05, FOREVER, 0.02)):
        assert record(tmp_path).process == os.getpid()
    assert len(lines) == 1 and "an unknown process" in lines[0]


def test_a_record_that_cannot_be_read_is_one_of_another_process(tmp_path, hold):
    hold()
    (tmp_path / "run" / "lock").write_bytes(b"damaged")
    with pytest.raises(Busy, match="another process"), locked(tmp_path / "run"):
        pass


class Clock:
    """Time that passes in sleeps and in looks at the file, and the looks' seconds."""

    def __init__(self, seconds):
        self.now, self.seconds, self.looks = 0.0, seconds, 0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds

    def read(self, path):
        self.now += self.seconds.get(self.looks, 0)
        self.looks += 1
        return b"content", 0.0


@pytest.mark.parametrize(
    ("seconds", "looks"),
    [({}, 10), ({4: 1.9}, 10), ({4: 60}, 15), ({9: 60}, 20), ({3: 3, 13: 3}, 24)],
)
def test_the_time_begins_again_after_a_look_that_hung(monkeypatch, tmp_path, seconds, looks):
    clock = Clock(seconds)
    monkeypatch.setattr(folder_lock, "time", clock)
    monkeypatch.setattr(lock_record, "read", clock.read)
    folder_lock._watch(tmp_path, b"content", Timing(expires=20))
    assert clock.looks == looks and clock.now == pytest.approx(2 * looks + sum(seconds.values()))


# Races


@pytest.mark.parametrize("flock", ["local", "real"])
def test_of_two_processes_that_race_for_an_expired_lock_one_gets_it(tmp_path, hold, start, flock):
    kill(hold("z"))
    racers = [start(host, flock, expires=0.5) for host in "bc"]
    for process in racers:
        go(process)
    answers = [process.stdout.readline() for process in racers]
    # If one was delayed for longer than it settles, the other one gets the lock first and loses it at its next beat.
    deadline = time.monotonic() + 20
    while answers == ["locked\n"] * 2 and all(process.poll() is None for process in racers):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    for process in racers:
        process.stdin.close()
        process.wait()
    ends = sorted((answer.split()[0], process.returncode) for answer, process in zip(answers, racers, strict=True))
    assert ends in ([("busy:", 0), ("locked", 0)], [("locked", 0), ("locked", 130)]), answers


def test_of_many_that_race_one_goes_on(tmp_path, local_flock):
    timing, racers = Timing(0.05, 0.1, FOREVER, 0.05), 6

    def race(host, barrier, ends):
        lost = threading.Event()
        barrier.wait()
        try:
            with locked(folder, host=host, timing=timing, lost=lambda line: lost.set()):
                deadline = time.monotonic() + 20
                while len(ends) < racers - 1 and not lost.is_set() and time.monotonic() < deadline:
                    time.sleep(0.01)
                ends.append("lost" if lost.is_set() else "locked")
        except Busy:
            ends.append("busy")

    for number, last in enumerate(["", "", lock_record.encode(lock_record.new_record("z"))]):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "lock").write_bytes(last or b"")
        barrier, ends = threading.Barrier(racers), []
        threads = [threading.Thread(target=race, args=(host, barrier, ends)) for host in "abcdef"]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(ends) == racers and ends.count("locked") == 1, ends


# Jobs that an engine starts again


def test_a_later_attempt_awaits_the_lock_of_an_earlier_one(tmp_path, hold, monkeypatch):
    process = hold("b", SQT_JOB=JOB)
    monkeypatch.setenv("SQT_JOB", JOB)
    lines = []

    def end(line):
        lines.append(line)
        threading.Timer(0.2, process.kill).start()

    with locked(tmp_path / "run", end, host="a", timing=Timing(0.1, 0.5, FOREVER, FOREVER)):
        assert record(tmp_path / "run").process == os.getpid()
    assert len(lines) == 1 and f"process {process.pid}, job {JOB}, an earlier attempt at this job" in lines[0]


def test_it_awaits_it_for_a_while(tmp_path, hold, monkeypatch):
    hold(SQT_JOB=JOB)
    monkeypatch.setenv("SQT_JOB", JOB)
    began = time.monotonic()
    with pytest.raises(Busy, match=f"job {JOB}"), locked(tmp_path / "run", timing=Timing(0.1, 0.5, 0.3, FOREVER)):
        pass
    assert time.monotonic() - began >= 0.3


@pytest.mark.parametrize("job", [{"SLURM_JOB_ID": "90"}, {"SQT_JOB": "91"}, {}])
def test_another_process_does_not_await_it(tmp_path, hold, monkeypatch, job):
    hold(SLURM_JOB_ID="90")  # the same attempt, another job, none
    for name, value in job.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(Busy, match="job 90"), locked(tmp_path / "run", pytest.fail):
        pass


def test_a_later_attempt_on_another_host_does_not_watch(tmp_path, hold, monkeypatch):
    kill(hold("b", SLURM_JOB_ID="90"))
    monkeypatch.setenv("SLURM_JOB_ID", "90")
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    with locked(tmp_path / "run", pytest.fail, host="a", timing=Timing(0.1, FOREVER, FOREVER, 0.1)):
        assert record(tmp_path / "run").host == "a"


def test_an_earlier_attempt_that_lives_ends_before_the_later_one_goes_on(tmp_path, hold, monkeypatch, local_flock):
    process = hold("b", "local", SQT_JOB=JOB)
    monkeypatch.setenv("SQT_JOB", JOB)
    with locked(tmp_path / "run", pytest.fail, host="a", timing=Timing(1.5, FOREVER, FOREVER, 0.1)):
        assert process.poll() == 130  # it beats every 0.1 s and had 1.6
        assert record(tmp_path / "run").host == "a"


# Who holds it


def test_the_holder_of_a_folder_is_read_without_its_lock(tmp_path, hold, monkeypatch):
    assert folder_lock.holder(tmp_path / "run") is None
    process = hold("b", SQT_JOB=JOB)
    monkeypatch.setattr(fcntl, "flock", pytest.fail)
    assert folder_lock.holder(tmp_path / "run") == ("b", process.pid, JOB, True)
    kill(process)
    now = time.time()
    for seconds, alive in ((0, True), (70, True), (80, False), (-50, True), (-70, None)):
        os.utime(tmp_path / "run" / "lock", (now - seconds, now - seconds))
        assert folder_lock.holder(tmp_path / "run").alive is alive


def test_a_holder_of_this_host_that_was_killed_is_not_alive(tmp_path, hold):
    process = hold()
    assert folder_lock.holder(tmp_path / "run").alive is True
    process.kill()  # nobody has waited for it yet: its number is still taken
    give_up = time.monotonic() + 30
    while folder_lock.holder(tmp_path / "run").alive and time.monotonic() < give_up:
        time.sleep(0.01)
    assert folder_lock.holder(tmp_path / "run").alive is False
    process.wait()
    assert folder_lock.holder(tmp_path / "run").alive is False


def test_nobody_holds_a_released_or_empty_lock(tmp_path):
    with locked(tmp_path):
        assert folder_lock.holder(tmp_path).process == os.getpid()
    assert folder_lock.holder(tmp_path) is None
    (tmp_path / "lock").write_bytes(b"")
    assert folder_lock.holder(tmp_path) is None


@pytest.mark.parametrize("content", DAMAGED[1:4])
def test_the_holder_of_a_damaged_lock_is_unknown(tmp_path, content):
    (tmp_path / "lock").write_bytes(content)
    assert folder_lock.holder(tmp_path) == ("", None, "", None)
    (tmp_path / "lock").unlink()
    (tmp_path / "lock").symlink_to(tmp_path)
    assert folder_lock.holder(tmp_path) == ("", None, "", None)
