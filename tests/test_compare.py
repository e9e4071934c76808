"""Peers against ours: rates of all seeds, trained in every way, and their ratios."""

import os
import sys

import jax
import pytest

from experiments.benchmarks import compare, measurements
from experiments.benchmarks.measurements import Failure, Measurement, Prepared
from experiments.benchmarks.timing import Timed


def test_a_missing_package_of_an_interpreter_is_found(monkeypatch):
    monkeypatch.setitem(compare.NEEDS, "sbx", "no_such_module")
    monkeypatch.setitem(compare.NEEDS, "torch", "json")
    assert compare.lacks("sbx", sys.executable) and not compare.lacks("torch", sys.executable)
    assert compare.lacks("torch", "/no/such/python") and compare.lacks("torch", os.sep)


def test_several_seeds_are_trained_in_every_way(monkeypatch):
    monkeypatch.setattr(compare, "usable_cores", lambda: 2)
    assert (
        compare.process_counts(1) == [1]
        and compare.process_counts(2) == [1, 2]
        and compare.process_counts(3) == [1, 2, 3]
    )
    assert compare.process_counts(20) == [1, 2, 4]  # at most two for each core
    monkeypatch.setattr(compare, "usable_cores", lambda: 16)
    assert compare.process_counts(5) == [1, 5] and compare.process_counts(20) == [1, 16, 20]


def test_seeds_are_trained_in_full_rounds_and_a_round_of_the_rest():
    rates = {1: 10.0, 2: 8.0, 3: 6.0, 5: 4.0}  # steps a second of each process
    # Five seeds make a step each: two rounds of two in 2/8 s, then one in 1/10 s.
    assert compare.rate_of_all(5, 2, rates) == pytest.approx(5 / (0.25 + 0.1))
    assert compare.rate_of_all(5, 1, rates) == pytest.approx(10.0)
    assert compare.rate_of_all(5, 5, rates) == pytest.approx(20.0)
    assert compare.rate_of_all(4, 2, rates) == pytest.approx(16.0)
    assert compare.rate_of_all(5, 3, rates) == pytest.approx(5 / (1 / 6 + 1 / 8))  # the rest is two in parallel


class Peer:
    """Processes that are not started."""

    def __init__(self, interpreter, program, arguments, processes, environment):
        if processes == 3:
            raise RuntimeError("no room")
        self.processes = processes

    def __call__(self, steps):
        pass

    def close(self):
        pass


def compared(monkeypatch, members, run=lambda steps: None):
    """A peer against ours: one process makes 12 steps per second, several 10 each; ours 10 of all members together."""
    runs = []

    def timed(run):
        processes = run.processes if isinstance(run, Peer) else 0
        runs.append(processes)
        return Timed((12.0 if processes == 1 else 10.0,) * 3, 0.5)

    monkeypatch.setattr(compare, "usable_cores", lambda: 2)
    monkeypatch.setattr(compare, "updates", lambda algo, task, members, devices: Prepared(run, operations=7.0))
    monkeypatch.setattr(measurements, "rates_or_errors", lambda runs, **timing: [timed(run) for run in runs])
    monkeypatch.setattr(compare, "PeerProcesses", Peer)
    timing = {"seconds": 0.0, "repeats": 1}
    return list(compare.compare("torch", "td7", "ant", members, [], sys.executable, os.environ, **timing)), runs


def test_rates_are_of_all_seeds(monkeypatch):
    """The peer's rate counts one seed at a time, or all in parallel; ours counts all members."""
    rows, runs = compared(monkeypatch, 6)
    assert [(row.what, row.rate) for row in rows] == [
        ("td7 on ant, sqt_jax", 60.0),
        ("td7 on ant, torch, one after the other", 12.0),
        ("td7 on ant, torch, 2 processes", 20.0),
        ("td7 on ant, torch, 4 processes", pytest.approx(6 / (1 / 10 + 1 / 10))),  # the rest is two
    ]
    assert runs == [0, 1, 2, 4] and {row.members for row in rows} == {6}
    assert {row.unit for row in rows} == {"member updates"}
    assert [row.compile_seconds for row in rows] == [0.5, None, None, None]  # not measured for the peer


def test_processes_that_do_not_start_are_a_failure_and_the_others_are_measured(monkeypatch):
    rows, runs = compared(monkeypatch, 3)
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
def test_pytorch_uses_our_device(monkeypatch, backend, device):
    given = []
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(compare, "measure_cases", lambda cases, **timing: [case.prepare() for case in cases[1:]] and [])
    monkeypatch.setattr(compare, "PeerProcesses", lambda *options: given.append(options[2]) or Peer(*options))
    list(compare.compare("torch", "td7", "ant", 1, [], sys.executable, os.environ))
    assert given == [["27", "8", device]]


def test_our_rate_is_compared_with_the_peers_best():
    def row(what, members, rate):
        return Measurement("compare", what, members, "env steps", rate)

    rows = [
        row("td3 on ant, sqt_jax, mujoco", 5, 300.0),
        row("td3 on ant, sqt_jax, mjx", 5, 250.0),
        row("td3 on ant, sbx, one after the other", 5, 100.0),
        row("td3 on ant, sbx, 2 processes", 5, 150.0),
        row("td3 on ant, sbx", 1, 400.0),
        row("sac on ant, sbx, 2 processes", 5, 900.0),
        Measurement("loop", "td3 on ant, mujoco", 5, "env steps", 300.0),
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
