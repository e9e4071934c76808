"""Groups of environments in worker processes: signals and ends. The episodes themselves are in test_host.py."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from host_tasks import Counter

from sqt_jax.envs.host_processes import Group, ProcessRows, _words
from sqt_jax.envs.host_rows import LocalRows

KEYS = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], np.uint32)
ACTIONS = np.array([[0.5, 0, 0], [0, 1, 0], [0, 0, 0]], np.float32)

SCRIPT = """
import functools, sys, time
import numpy as np
from host_tasks import Counter
from sqt_jax.envs.host_processes import ProcessRows

if __name__ == "__main__":
    rows = ProcessRows(functools.partial(Counter, seconds=1000), 2, 2, (3, 3))
    rows.start(np.zeros((2, 3), np.uint32))
    print(*[worker.pid for worker in rows.workers.processes], flush=True)
    if sys.argv[1] == "step":
        rows.step(np.zeros((2, 3), np.float32), np.zeros((2, 3), np.uint32))
    time.sleep(60 if sys.argv[1] == "wait" else 0)
"""


def test_workers_ignore_the_signals_of_a_job_and_play_on():
    rows, local = ProcessRows(Counter, 3, 2, (3, 3)), LocalRows(Counter, 3)
    np.testing.assert_array_equal(rows.start(KEYS), local.start(KEYS))
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR2):
        for worker in rows.workers.processes:
            os.kill(worker.pid, number)
    time.sleep(0.2)
    np.testing.assert_array_equal(rows.step(ACTIONS, KEYS), local.step(ACTIONS, KEYS))
    rows.close()
    assert not any(worker.is_alive() for worker in rows.workers.processes)


def test_no_more_workers_than_environments():
    rows = ProcessRows(Counter, 1, 8, (3, 3))
    assert len(rows.workers.processes) == 1
    rows.close()


@pytest.mark.parametrize("end", ["by itself", "SIGKILL", pytest.param("in a step", marks=pytest.mark.slow)])
def test_no_worker_outlives_its_run(tmp_path, end):
    (tmp_path / "script.py").write_text(SCRIPT)
    paths = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parent.parent)])
    command = [sys.executable, "script.py", {"by itself": "end", "SIGKILL": "wait"}.get(end, "step")]
    with subprocess.Popen(
        command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": paths}, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        workers = [int(word) for word in process.stdout.readline().split()]
        assert len(workers) == 2
        if end != "by itself":
            time.sleep(1.0 if end == "in a step" else 0.0)
            process.kill()
        process.wait(60)
        deadline = time.monotonic() + 20
        while any(map(alive, workers)) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert not any(map(alive, workers))
        printed = process.stderr.read().decode()
    assert "Traceback" not in printed
    assert (process.returncode == 0 and printed == "") if end == "by itself" else process.returncode == -9


def alive(pid):
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_a_group_in_the_main_process_stays_empty_and_does_not_end_it():
    group = Group(Counter, (3, 3), 1, 1, os.getpid())
    assert group.rows.envs == []
    group.close()


def test_the_words_of_calls():
    assert _words(KEYS[:1], None).tolist() == [[0, 1, 2, 3]]
    assert _words(KEYS[:1], ACTIONS[:1]).tolist() == [[1, 1, 2, 3, 0x3F000000, 0, 0]]
