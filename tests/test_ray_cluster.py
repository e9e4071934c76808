"""The Ray launcher: with a stand-in for the process that talks to Ray, and (slow) on a cluster of three nodes."""

import json
import sys
from pathlib import Path

import pytest

from experiments.commandline.arguments import DONE, FAILED, INTERRUPTED, UsageError
from experiments.launchers import ray_cluster
from experiments.launchers.cell import Cell, Ended, write_ended
from experiments.launchers.ray_cluster import RayLauncher, forwarded_variables, make
from experiments.launchers.ray_options import RayOptions

CELLS = [Cell(str(index), "td3", Path("out") / str(index), ("--steps=5",)) for index in range(3)]
START = """
import json, sys, os, time
def tell(**message): print(json.dumps(message), flush=True)
settings = json.loads(sys.stdin.readline())
"""
SERVE = (
    START
    + """
tell(connected=True); tell(ready=True)
numbers = []
for line in sys.stdin:
    message = json.loads(line)
    numbers += [fields[0] for fields in message.get("submit", ())]
    %s
"""
)
END_ALL = """for number in numbers: tell(ended=[number, 0, "", False])
    numbers.clear()"""


@pytest.fixture
def launch(tmp_path):
    """A launcher whose driver is a script."""

    def make_launcher(script, address="10.0.0.7:6379", **options):
        program = (sys.executable, "-c", script)
        return RayLauncher(RayOptions(**options), tmp_path / "out", address, program)

    return make_launcher


def all_ended(launcher, number, tries=60):
    found = []
    for _ in range(tries):
        found += launcher.ended()
        if len(found) >= number:
            return found
    raise AssertionError(found)


def test_cells_end_as_the_driver_says(launch, tmp_path):
    with launch(SERVE % END_ALL) as launcher:
        launcher.submit(CELLS[:2])
        assert len([*(tmp_path / "out").glob(".shared_*")]) == 1
        assert all_ended(launcher, 2) == [Ended(cell, DONE, "") for cell in CELLS[:2]]
        launcher.submit([CELLS[0]])  # again
        assert all_ended(launcher, 1) == [Ended(CELLS[0], DONE, "")]
    assert not any((tmp_path / "out").iterdir())


def test_the_driver_knows_the_cells_and_what_they_need(launch, tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    script = SERVE % f"open({str(tmp_path / 'seen')!r}, 'a').write(json.dumps(settings) + '\\n' + line)\n    {END_ALL}"
    with launch(script, num_cpus=2) as launcher:
        launcher.submit(CELLS[:1])
        all_ended(launcher, 1)
    settings, message = map(json.loads, (tmp_path / "seen").read_text().splitlines())
    assert settings["address"] == "10.0.0.7:6379" and settings["options"]["num_cpus"] == 2
    assert settings["variables"]["JAX_PLATFORMS"] == "cpu" and Path(settings["folder"]) == Path.cwd()
    assert settings["expected"][0] == str(tmp_path / "out")
    assert message == {"submit": [[0, "0", "td3", "out/0", ["--steps=5"]]]}


def test_cancelling_reaches_the_driver(launch):
    cancel = 'if "cancel" in message: tell(ended=[numbers.pop(0), 130, "interrupted", False])'
    with launch(SERVE % cancel) as launcher:
        launcher.cancel()  # before there is anything
        launcher.submit(CELLS[:2])
        assert launcher.ended() == []
        for cell in CELLS[:2]:
            launcher.cancel()
            assert all_ended(launcher, 1) == [Ended(cell, INTERRUPTED, "interrupted")]


@pytest.mark.parametrize(
    ("end", "why"),
    [
        ('print("[2026 E 5] rpc.h:7: GCS is gone. See", file=sys.stderr); os._exit(1)', "GCS is gone"),
        ("os._exit(1)", "its process was killed"),
        ('tell(lost="raylet died"); sys.exit()', "raylet died"),
    ],
)
def test_a_lost_cluster_ends_all_cells(launch, end, why):
    script = SERVE % f'tell(ended=[numbers.pop(0), 0, "", False]); {end}'
    with launch(script) as launcher:
        launcher.submit(CELLS)
        first, *others = all_ended(launcher, 3)
        assert first == Ended(CELLS[0], DONE, "")
        assert others == [Ended(cell, FAILED, f"the Ray cluster is gone: {why}") for cell in CELLS[1:]]


@pytest.mark.parametrize(
    ("script", "line"),
    [
        ('tell(refused="--ray: expects less")', "--ray: expects less"),
        ('tell(connected=True); tell(refused="--out: expects a folder")', "--out: expects a folder"),
        ('tell(connected=True); tell(lost="raylet died")', "--launcher=ray: Ray ended: raylet died"),
        ('raise ValueError("wrong")', "--launcher=ray: Ray ended: ValueError: wrong"),
        ("time.sleep(600)", "RAY_ADDRESS=10.0.0.7:6379: expects a Ray cluster; none answers within 1 s"),
        ("tell(connected=True); time.sleep(600)", "RAY_ADDRESS=10.0.0.7:6379: its nodes do not answer within 1 s"),
    ],
)
def test_what_is_refused_is_one_line(launch, tmp_path, monkeypatch, script, line):
    if "sleep" in script:
        name = "READY_SECONDS" if "connected" in script else "CONNECT_SECONDS"
        monkeypatch.setattr(ray_cluster, name, 1.0)
    launcher = launch(START + script)
    with pytest.raises(UsageError) as error, launcher:
        launcher.submit(CELLS)
    assert str(error.value) == line
    assert not any((tmp_path / "out").iterdir())


def test_nothing_to_train_needs_no_cluster(launch, tmp_path):
    with launch("") as launcher:
        launcher.submit([])
        assert launcher.ended() == []
    assert not (tmp_path / "out").exists()


def test_variables_of_jax_and_of_python_go_along():
    variables = {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": "", "PYTHONPATH": "a", "PATH": "b", "RAY_ADDRESS": "c"}
    assert forwarded_variables(variables) == {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": "", "PYTHONPATH": "a"}


@pytest.mark.parametrize(
    ("address", "found", "line"),
    [
        ("", None, "--launcher=ray: expects the package ray; pip install 'sqt_jax[ray]'"),
        ("ray://head:10001", True, "RAY_ADDRESS=ray://head:10001: expects HOST:PORT of a cluster that this machine"),
    ],
)
def test_a_missing_package_and_an_address_of_another_kind_are_refused(tmp_path, monkeypatch, address, found, line):
    monkeypatch.setenv("RAY_ADDRESS", address)
    monkeypatch.setattr(ray_cluster.importlib.util, "find_spec", lambda _: found)
    with pytest.raises(UsageError) as error:
        make("", tmp_path)
    assert str(error.value).startswith(line)


def test_a_cell_that_is_done_is_not_lost_with_the_cluster(launch, tmp_path):
    cells = [cell._replace(path=tmp_path / cell.path) for cell in CELLS]
    with launch(SERVE % "os._exit(1)") as launcher:
        for cell, code in zip(cells, (DONE, FAILED), strict=False):
            cell.path.parent.mkdir(exist_ok=True)
            write_ended(Ended(cell, code, ""))
        launcher.submit(cells)
        assert [ended.code for ended in all_ended(launcher, 3)] == [DONE, FAILED, FAILED]
