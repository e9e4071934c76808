"""Peers beside ours: programs of their own, spoken to line by line."""

import os
import sys

import pytest

from experiments import compare
from experiments.measure import Row

PROGRAM = """
import sys
print("ready", flush=True)
made = open(sys.argv[1] + sys.argv[2], "w")
for line in sys.stdin:
    if line == "13\\n":
        sys.exit("unlucky")
    print(line, end="", file=made, flush=True)
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
    assert [(tmp_path / f"made{seed}").read_text() for seed in range(3)] == ["5\n7\n"] * 3
    assert three.start_seconds > 0


def test_a_peer_that_ends_is_an_error_and_not_a_figure(peer):
    two = peer(2)
    with pytest.raises(RuntimeError, match="ended: .*program.py"):
        two(13)
    assert all(process.poll() is not None for process in two.processes)


def test_what_an_interpreter_cannot_import_is_known(monkeypatch):
    monkeypatch.setitem(compare.NEEDS, "sbx", "no_such_module")
    monkeypatch.setitem(compare.NEEDS, "torch", "json")
    assert compare.lacks("sbx", sys.executable) and not compare.lacks("torch", sys.executable)
    assert compare.lacks("torch", "/no/such/python") and compare.lacks("torch", os.sep)


def test_several_seeds_are_trained_in_every_way(monkeypatch):
    monkeypatch.setattr(compare, "usable_cores", lambda: 2)
    assert compare.ways(1) == [1] and compare.ways(2) == [1, 2] and compare.ways(5) == [1, 2, 5]


def test_a_row_is_told_per_step_of_one_seed(peer, monkeypatch):
    """Theirs one after the other counts one seed, side by side all; ours all members."""
    monkeypatch.setattr(compare, "usable_cores", lambda: 2)
    monkeypatch.setattr(compare, "updates", lambda algo, task, members: (lambda steps: None, 1.0))
    monkeypatch.setattr(compare, "measure_in_turns", lambda runs, **timing: [(10.0, 0.0) for _ in runs])
    monkeypatch.setattr(
        compare, "Peer", lambda interpreter, program, arguments, processes, environment: peer(processes)
    )
    rows = list(compare.compare("torch", "td7", "ant", 5, [], sys.executable, os.environ, seconds=0.0, repeats=1))
    assert [(row.what, row.rate) for row in rows] == [
        ("td7 on ant, sqt_jax", 50.0),
        ("td7 on ant, torch, one after the other", 10.0),
        ("td7 on ant, torch, 2 processes", 20.0),
        ("td7 on ant, torch, 5 processes", 50.0),
    ]
    assert {row.unit for row in rows} == {"member updates"}


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
