"""Cores that processes of one machine divide among them."""

import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from experiments.launchers import node_cores
from experiments.launchers.node_cores import reserved_cores

ROOT = Path(__file__).resolve().parent.parent
pytestmark = pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system has no affinity")


@pytest.fixture
def four_cores(monkeypatch):
    """A machine with cores 2, 3, 5 and 7."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {7, 2, 3, 5})


def test_contexts_share_no_core(four_cores, tmp_path):
    with ExitStack() as stack:
        taken = [stack.enter_context(reserved_cores(count, 4, tmp_path)) for count in (1, 2, 1)]
    assert taken == [(2,), (3, 5), (7,)]
    with reserved_cores(3, 4, tmp_path) as cores:  # all are free again
        assert cores == (2, 3, 5)


def test_where_too_few_are_free_some_are_shared(four_cores, tmp_path):
    with reserved_cores(3, 4, tmp_path) as first, reserved_cores(2, 4, tmp_path) as second:
        assert first == (2, 3, 5) and second == (2, 7)


def test_all_cores_need_no_choice(four_cores, tmp_path):
    with reserved_cores(4, 4, tmp_path) as cores:
        assert cores == ()
    assert not any(tmp_path.iterdir())


def test_without_a_folder_for_locks_cores_are_chosen_all_the_same(four_cores, tmp_path):
    (tmp_path / "file").touch()
    with reserved_cores(2, 4, tmp_path / "file") as cores:
        assert cores == (2, 3)


def test_idle_cores_come_first_where_others_use_the_machine(four_cores, tmp_path, monkeypatch):
    monkeypatch.setattr(node_cores.psutil, "cpu_percent", lambda *_, **__: [99.0] * 5 + [1.0, 1.0, 1.0])
    for begin in range(4):
        monkeypatch.setattr(node_cores.random, "randrange", lambda _, begin=begin: begin)
        with reserved_cores(2, 2, tmp_path) as cores:
            assert cores == (5, 7)


def test_another_process_holds_its_cores_until_it_is_killed(tmp_path):
    script = (
        "import os, sys, time, pathlib; os.sched_getaffinity = lambda _: {0, 1}\n"
        "from experiments.launchers.node_cores import reserved_cores\n"
        "with reserved_cores(1, 2, pathlib.Path(sys.argv[1])) as cores: print(cores, flush=True); time.sleep(600)"
    )
    command = [sys.executable, "-c", script, str(tmp_path)]
    options = {"stdout": subprocess.PIPE, "text": True, "env": os.environ | {"PYTHONPATH": str(ROOT)}}
    lines = []
    with ExitStack() as stack:
        for _ in range(2):
            process = stack.enter_context(subprocess.Popen(command, **options))
            stack.callback(process.kill)
            lines.append(process.stdout.readline())
        process.kill()
        process.wait()
        process = stack.enter_context(subprocess.Popen(command, **options))
        stack.callback(process.kill)
        lines.append(process.stdout.readline())
    assert lines == ["(0,)\n", "(1,)\n", "(1,)\n"]
