"""Peers run as processes of their own that read numbers of steps line by line."""

import os
import sys

import pytest

from experiments.benchmarks import peer_process
from experiments.benchmarks.peer_process import PeerProcesses, core_shares, our_cores

PROGRAM = """
import os, sys
print("a library's own line", flush=True)
cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
made = open(sys.argv[1] + sys.argv[2], "w")
print(os.environ["OMP_NUM_THREADS"], cores, file=made, flush=True)
print("ready", flush=True)
for line in sys.stdin:
    if line == "13\\n":
        print("a warning", file=sys.stderr)
        sys.exit("unlucky")
    print(line, end="", file=made, flush=True)
    print("undone\\nready", flush=True)
    print("done", flush=True)
"""


@pytest.fixture
def peer(tmp_path, monkeypatch):
    """Starts a number of processes of a program that writes down its steps."""
    (tmp_path / "program.py").write_text(PROGRAM)
    monkeypatch.setattr(peer_process, "PEERS", tmp_path)
    started = []

    def start(processes):
        made = PeerProcesses(sys.executable, "program.py", [str(tmp_path / "made")], processes, os.environ)
        started.append(made)
        return made

    yield start
    for made in started:
        made.close()


def test_each_process_makes_the_steps(peer, tmp_path):
    three = peer(3)
    three(5)
    three(7)
    assert [(tmp_path / f"made{seed}").read_text().splitlines()[1:] for seed in range(3)] == [["5", "7"]] * 3


def test_each_process_has_its_share_of_the_cores_and_ours_has_all_again(peer, tmp_path):
    ours = our_cores()
    peer(2)
    for seed, cores in enumerate(core_shares(ours, 2)):
        written = (tmp_path / f"made{seed}").read_text()
        assert written == f"{len(cores)} {cores if hasattr(os, 'sched_getaffinity') else []}\n"
    assert our_cores() == ours


def test_shares_are_own_cores_or_one_shared_core():
    assert core_shares([0, 1, 4, 5], 1) == [[0, 1, 4, 5]]
    assert core_shares([0, 1, 4, 5], 2) == [[0, 1], [4, 5]]
    assert core_shares([0, 1, 4, 5], 3) == [[0], [1], [4, 5]]
    assert core_shares([0, 1], 5) == [[0], [1], [0], [1], [0]]


def test_a_peer_that_ends_is_an_error(peer):
    two = peer(2)
    with pytest.raises(RuntimeError, match="^program.py ended: unlucky$"):
        two(13)
    assert all(process.poll() is not None for process in two.processes)


def test_a_peer_that_has_ended_before_it_gets_its_steps_is_an_error(peer):
    one = peer(1)
    one.processes[0].kill()
    one.processes[0].wait()
    with pytest.raises(RuntimeError, match="^program.py ended: it wrote no error$"):
        one(5)


def test_a_peer_that_does_not_start_is_an_error_with_its_last_line(peer, tmp_path):
    (tmp_path / "program.py").write_text("import no_such_module")
    with pytest.raises(RuntimeError, match="^program.py ended: ModuleNotFoundError: No module named 'no_such_module'$"):
        peer(2)
