"""The suite gpu: its parts in order, each in a process with its own flags of XLA."""

import json

import pytest

from experiments.benchmarks import gpu_process, measure_gpu
from experiments.benchmarks.measure_gpu import PARTS, Part, parts_of
from experiments.surroundings.gpu_options import DETERMINISTIC, OPTIONS

SHORT = {"seconds": 0.0, "repeats": 1}


def loops(parts):
    return [(part.arguments["physics"], part.arguments["members"]) for part in parts if part.kind == "loop"]


def test_the_most_telling_part_comes_first():
    parts = parts_of(PARTS, "ant", [25, 100, 250], ["mujoco", "mjx", "warp"], **SHORT)
    assert loops(parts)[:5] == [("warp", 25), ("warp", 250), ("mjx", 25), ("mujoco", 25), ("mujoco", 100)]
    kinds = [part.kind for part in parts[5:]]
    expected = ["parity"] + ["profile"] * 2 + ["loop"] * 2 + ["exact"] * 3 + ["loop"] * (len(OPTIONS) + 1)
    assert kinds == expected + ["parity"] * 2
    assert [part.arguments["task"] for part in parts if part.kind == "parity"] == ["ant", "cheetah", "humanoid"]
    assert parts[8].arguments["algo"] == "td7_sqt"
    exact = [(part.arguments["physics"], part.flags) for part in parts if part.kind == "exact"]
    assert exact == [("mjx", DETERMINISTIC), ("warp", DETERMINISTIC), ("mjx", "")]


def test_nine_minutes_suffice_for_the_first_three_parts():
    parts = parts_of(PARTS[:3], "ant", [25, 100, 250], measure_gpu.PHYSICS, **SHORT)
    assert sum(part.limit for part in parts) <= 540


def test_each_option_has_a_process_of_its_own():
    parts = parts_of(["options"], "ant", [25], ["warp"], **SHORT)
    assert [part.flags for part in parts] == [option.flags for option in OPTIONS.values()]
    assert len({part.arguments["label"] for part in parts}) == len(OPTIONS)


def test_graphs_of_loops_are_measured_with_mjx_too():
    parts = parts_of(["options"], "ant", [25], ["warp", "mjx"], **SHORT)
    assert [part.arguments["physics"] for part in parts] == ["mjx"] + ["warp"] * len(OPTIONS)
    assert parts[0].flags == OPTIONS["loops"].flags


def test_parts_physics_and_members_can_be_fewer():
    parts = parts_of(["td7", "loops"], "cheetah", [2], ["mujoco"], **SHORT)
    assert [part.arguments["algo"] for part in parts] == ["td3_sqt", "td7_sqt"]
    assert loops(parts) == [("mujoco", 2)] * 2  # one number of members, one loop
    assert loops(parts_of(["loops"], "ant", [2, 3], ["mjx", "warp"], **SHORT)) == [("warp", 2), ("warp", 3), ("mjx", 2)]


@pytest.mark.parametrize("physics", measure_gpu.PHYSICS)
def test_processes_accept_their_arguments(physics):
    for part in parts_of(PARTS, "ant", [25, 100, 250], [physics], **SHORT):
        json.dumps(part.arguments)
        assert part.limit > 0 and gpu_process.KINDS[part.kind](**part.arguments) is not None


def test_each_process_has_its_flags(monkeypatch):
    seen = []

    def results(command, what, limit, environment):
        seen.append((command[-2:], what, limit, environment["XLA_FLAGS"]))
        yield what

    monkeypatch.setattr(measure_gpu.part_process, "results", results)
    monkeypatch.setenv("XLA_FLAGS", "--xla_mine=1")
    parts = [Part("parity", {"task": "ant", "physics": "mjx"}, 7), Part("exact", {"task": "ant"}, 8, DETERMINISTIC)]
    found = list(measure_gpu.bench_gpu(parts, patience=2))
    assert found[::2] == ["parity: ant, mjx", "exact: ant"]
    assert [row.what for row in found[1::2]] == ["parity: ant, mjx, of 14 s", "exact: ant, of 16 s"]
    assert seen == [
        (["parity", '{"task": "ant", "physics": "mjx"}'], "parity: ant, mjx", 14, "--xla_mine=1"),
        (["exact", '{"task": "ant"}'], "exact: ant", 16, f"--xla_mine=1 {DETERMINISTIC}"),
    ]


def test_parts_share_the_minutes_and_the_last_are_left_out(monkeypatch):
    now, limits = [0.0], []

    def results(command, what, limit, environment):
        limits.append(limit)
        now[0] += 50.0
        yield what

    monkeypatch.setattr(measure_gpu.part_process, "results", results)
    parts = [Part("parity", {"task": name}, 90) for name in "abc"]
    found = list(measure_gpu.bench_gpu(parts, minutes=1.75, clock=lambda: now[0]))
    assert limits == [90, 55]  # of 105 s 50 and 50 are used
    assert [row.figure for row in found[1:4:2]] == [("50", "s"), ("50", "s")]
    assert found[4:] == [("parity: c", "it was not begun: the 1.75 minutes of all parts had passed")]
