"""Peers beside ours: programs of their own, spoken to line by line."""

import os
import sys

import jax
import pytest

from experiments.benchmarks import compare, measure
from experiments.benchmarks.measure import Failure, Made, Row

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
    """Starts so many processes of a peer that notes what it was told."""
    (tmp_path / "program.py").write_text(PROGRAM)
    monkeypatch.setattr(compare, "PEERS", tmp_path)
    started, make = [], compare.Peer

    def start(processes):
        made = make(sys.executable, "program.py", [str(tmp_path / "made")], processes, os.environ)
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
    ours = compare.our_cores()
    peer(2)
    for seed, cores in enumerate(compare.shares(ours, 2)):
        told = (tmp_path / f"made{seed}").read_text()
        assert told == f"{len(cores)} {cores if hasattr(os, 'sched_getaffinity') else []}\n"
    assert compare.our_cores() == ours


def test_shares_are_cores_of_its_own_or_one_in_turn():
    assert compare.shares([0, 1, 4, 5], 1) == [[0, 1, 4, 5]]
    assert compare.shares([0, 1, 4, 5], 2) == [[0, 1], [4, 5]]
    assert compare.shares([0, 1, 4, 5], 3) == [[0], [1], [4, 5]]
    assert compare.shares([0, 1], 5) == [[0], [1], [0], [1], [0]]


def test_a_peer_that_ends_is_an_error_and_not_a_figure(peer):
    two = peer(2)
    with pytest.raises(RuntimeError, match="^program.py ended: unlucky$"):
        two(13)
    assert all(process.poll() is not None for process in two.processes)


def test_a_peer_that_has_ended_before_it_is_told_is_an_error(peer):
    one = peer(1)
    one.processes[0].kill()
    one.processes[0].wait()
    with pytest.raises(RuntimeError, match="^program.py ended: it wrote no error$"):
        one(5)


def test_a_peer_that_does_not_start_is_an_error_with_its_last_line(peer, tmp_path):
    (tmp_path / "program.py").write_text("import no_such_module")
    with pytest.raises(RuntimeError, match="^program.py ended: ModuleNotFoundError: No module named 'no_such_module'$"):
        peer(2)


def test_what_an_interpreter_cannot_import_is_known(monkeypatch):
    monkeypatch.setitem(compare.NEEDS, "sbx", "no_such_module")
    monkeypatch.setitem(compare.NEEDS, "torch", "json")
    assert compare.lacks("sbx", sys.executable) and not compare.lacks("torch", sys.executable)
    assert compare.lacks("torch", "/no/such/python") and compare.lacks("torch", os.sep)


def test_several_seeds_are_trained_in_every_way(monkeypatch):
    monkeypatch.setattr(compare, "usable_cores", lambda: 2)
    assert compare.ways(1) == [1] and compare.ways(2) == [1, 2] and compare.ways(3) == [1, 2, 3]
    assert compare.ways(20) == [1, 2, 4]  # at most two for each core
    monkeypatch.setattr(compare, "usable_cores", lambda: 16)
    assert compare.ways(5) == [1, 5] and compare.ways(20) == [1, 16, 20]


def test_seeds_are_trained_in_full_rounds_and_a_round_of_the_rest():
    rates = {1: 10.0, 2: 8.0, 3: 6.0, 5: 4.0}  # steps a second of each process
    # Five seeds make a step each: two rounds of two in 2/8 s, one alone in 1/10 s.
    assert compare.together(5, 2, rates) == pytest.approx(5 / (0.25 + 0.1))
    assert compare.together(5, 1, rates) == pytest.approx(10.0)
    assert compare.together(5, 5, rates) == pytest.approx(20.0)
    assert compare.together(4, 2, rates) == pytest.approx(16.0)
    assert compare.together(5, 3, rates) == pytest.approx(5 / (1 / 6 + 1 / 8))  # the rest is two side by side


def compared(peer, monkeypatch, members, run=lambda steps: None):
    """Rows of a peer of which each process makes 10 steps a second, alone 12; ours makes 10 of all members."""
    runs = []

    def timed(run):
        processes = len(run.processes) if hasattr(run, "processes") else 0
        runs.append(processes)
        return (12.0 if processes == 1 else 10.0), 0.5

    def start(interpreter, program, arguments, processes, environment):
        if processes == 3:
            raise RuntimeError("no room")
        return peer(processes)

    monkeypatch.setattr(compare, "usable_cores", lambda: 2)
    monkeypatch.setattr(compare, "updates", lambda algo, task, members, devices: Made(run, operations=7.0))
    monkeypatch.setattr(measure, "tried_in_turns", lambda runs, **timing: [timed(run) for run in runs])
    monkeypatch.setattr(compare, "Peer", start)
    timing = {"seconds": 0.0, "repeats": 1}
    return list(compare.compare("torch", "td7", "ant", members, [], sys.executable, os.environ, **timing)), runs


def test_a_row_is_told_per_step_of_one_seed(peer, monkeypatch):
    """Theirs one after the other counts one seed, side by side all; ours all members."""
    rows, runs = compared(peer, monkeypatch, 6)
    assert [(row.what, row.rate) for row in rows] == [
        ("td7 on ant, sqt_jax", 60.0),
        ("td7 on ant, torch, one after the other", 12.0),
        ("td7 on ant, torch, 2 processes", 20.0),
        ("td7 on ant, torch, 4 processes", pytest.approx(6 / (1 / 10 + 1 / 10))),  # the rest is two
    ]
    assert runs == [0, 1, 2, 4] and {row.members for row in rows} == {6}
    assert {row.unit for row in rows} == {"member updates"}
    assert [row.compile_seconds for row in rows] == [0.5, None, None, None]  # of theirs it is not known


def test_a_way_that_cannot_be_started_is_told_and_the_others_are_measured(peer, monkeypatch):
    rows, runs = compared(peer, monkeypatch, 3)
    failed, *rows = rows
    assert failed == Failure("compare: td7 on ant, torch, 3 processes, 3 members", "RuntimeError: no room")
    assert runs == [0, 1, 2]
    assert [(row.what, row.rate) for row in rows] == [
        ("td7 on ant, sqt_jax", 30.0),
        ("td7 on ant, torch, one after the other", 12.0),
        ("td7 on ant, torch, 2 processes", pytest.approx(3 / (1 / 10 + 1 / 12))),
    ]
    assert compare.ratios(rows[:1]) == []


@pytest.mark.parametrize(("backend", "device"), [("cpu", "cpu"), ("gpu", "cuda")])
def test_pytorch_computes_where_we_do(peer, monkeypatch, backend, device):
    told = []
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(compare, "in_turns", lambda cases, **timing: [case.make() for case in cases[1:]] and [])
    monkeypatch.setattr(compare, "Peer", lambda *given: told.append(given[2]) or peer(1))
    list(compare.compare("torch", "td7", "ant", 1, [], sys.executable, os.environ))
    assert told == [["27", "8", device]]


def test_ours_is_compared_with_the_best_of_theirs():
    def row(what, members, rate):
        return Row("compare", what, members, "env steps", rate, 0.0)

    rows = [
        row("td3 on ant, sqt_jax, mujoco", 5, 300.0),
        row("td3 on ant, sqt_jax, mjx", 5, 250.0),
        row("td3 on ant, sbx, one after the other", 5, 100.0),
        row("td3 on ant, sbx, 2 processes", 5, 150.0),
        row("td3 on ant, sbx", 1, 400.0),
        row("sac on ant, sbx, 2 processes", 5, 900.0),
        Row("loop", "td3 on ant, mujoco", 5, "env steps", 300.0, 0.0),
    ]
    assert compare.ratios(rows) == [
        "td3 on ant, sqt_jax, mujoco, 5 members / sbx, 2 processes = 2.00",
        "td3 on ant, sqt_jax, mjx, 5 members / sbx, 2 processes = 1.67",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("peer_name", compare.NEEDS)
def test_a_peer_that_is_installed_is_measured(peer_name):
    if compare.lacks(peer_name, sys.executable):
        pytest.skip(f"{compare.INSTALL[peer_name]} is not installed")
    algo = compare.ALGORITHMS[peer_name][0]
    timing = {"seconds": 0.0, "repeats": 1}
    rows = list(compare.compare(peer_name, algo, "ant", 1, ["mujoco"], sys.executable, os.environ, **timing))
    assert len(rows) == 2 and all(row.rate > 0 for row in rows)
