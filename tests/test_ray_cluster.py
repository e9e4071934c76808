"""The Ray launcher: with a stand-in for the process that talks to Ray, and (slow) on a cluster of three nodes."""

import importlib.util
import json
import os
import signal
import sys
import time
from pathlib import Path

import psutil
import pytest
from ray_nodes import ray_nodes, runs_on
from started_sweeps import rows, start_sweep, wait_for

from experiments.commandline.arguments import BAD_USAGE, DONE, FAILED, INTERRUPTED, UsageError
from experiments.launchers import ray_cluster
from experiments.launchers.cell import Cell, Ended, write_ended
from experiments.launchers.ray_cluster import RayLauncher, driver_variables, forwarded_variables, make
from experiments.launchers.ray_options import RayOptions

BELONGS = f"expects {ray_cluster.BELONGING}"
ROOT = Path(__file__).resolve().parent.parent
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
    assert message == {"submit": [[0, "0", "td3", "out/0", ["--steps=5"], ""]]}


def test_a_cell_that_is_started_again_keeps_its_number_in_the_sweep(launch, tmp_path):
    script = SERVE % f"open({str(tmp_path / 'seen')!r}, 'a').write(settings['sweep'] + line)\n    {END_ALL}"
    for _ in range(2):
        with launch(script) as launcher:
            for cells in (CELLS[:2], CELLS[1:]):
                launcher.submit(cells)
                all_ended(launcher, 2)
    lines = (tmp_path / "seen").read_text().splitlines()
    assert len({line.partition("{")[0] for line in lines}) == 2  # sweeps
    numbers = [[fields[0] for fields in json.loads(line[line.index("{") :])["submit"]] for line in lines]
    assert numbers == [[0, 1], [1, 2]] * 2


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
        (
            "time.sleep(600)",
            f"RAY_ADDRESS=10.0.0.7:6379: {BELONGS}; none answers within 1 s",
        ),
        (
            "tell(connected=True); time.sleep(600)",
            "--launcher=ray: expects all nodes of the Ray cluster; none answers within 1 s",
        ),
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


def test_a_missing_token_is_named(launch, monkeypatch):
    monkeypatch.setattr(ray_cluster, "CONNECT_SECONDS", 1.0)
    script = (
        "import sys, time; print('RPC error: InvalidAuthToken: missing', file=sys.stderr, flush=True); time.sleep(600)"
    )
    line = f"RAY_ADDRESS=10.0.0.7:6379: {BELONGS}, and RAY_AUTH_MODE=token with the token of the cluster"
    with pytest.raises(UsageError, match=f"^{line}$"), launch(script) as launcher:
        launcher.submit(CELLS)


def test_a_cluster_that_is_started_reports_to_nobody_and_has_a_token_of_its_own():
    assert driver_variables("10.0.0.7:6379", {}) == {}
    tokens = {driver_variables(None, {})["RAY_AUTH_TOKEN"] for _ in range(2)}
    assert len(tokens) == 2 and driver_variables(None, {})["RAY_AUTH_MODE"] == "token"
    assert driver_variables(None, {"RAY_AUTH_MODE": "disabled"}) == {"RAY_USAGE_STATS_ENABLED": "0"}


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


ENGINE = [
    pytest.mark.slow,
    pytest.mark.engine,
    pytest.mark.skipif(not importlib.util.find_spec("ray"), reason="Ray is not installed: pip install '.[ray]'"),
    pytest.mark.skipif(sys.platform != "linux", reason="cores of one's own and tied processes need Linux"),
]


@pytest.fixture
def cluster(monkeypatch):
    """Two nodes with one CPU each, beside the head."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    with ray_nodes(2) as nodes:
        yield nodes


def engine_test(test):
    for mark in ENGINE:
        test = mark(test)
    return test


@engine_test
def test_a_grid_ends_the_same_after_a_killed_worker_a_lost_node_and_ctrl_c(tmp_path, cluster):
    cores = sorted(os.sched_getaffinity(0))
    plain = [start_sweep(tmp_path / "plain", f"--seeds={seed}", core=cores[seed % len(cores)]) for seed in (0, 1)]
    for sweep in plain:
        sweep.communicate()
    assert [sweep.returncode for sweep in plain] == [DONE, DONE] and len(rows(tmp_path / "plain")) == 6

    def half_done():
        return next(((node, run) for node in cluster.worker_nodes for run in runs_on(node) if run.is_half_done()), None)

    out, hit = tmp_path / "ray", []
    arguments = ("--launcher=ray", "--ray=num_cpus=1")
    sweep = start_sweep(out, *arguments, RAY_ADDRESS=cluster.address)
    _, run = wait_for(half_done)
    run.worker.kill()
    hit.append(run.path)
    wait_for(lambda: not run.process.is_running())
    node, run = wait_for(lambda: (found := half_done()) and found[1].path not in hit and found)
    cluster.remove_node(node, allow_graceful=False)
    hit.append(run.path)
    cluster.add_node(num_cpus=1)
    _, run = wait_for(lambda: (found := half_done()) and found[1].path not in hit and found)
    os.killpg(sweep.pid, signal.SIGINT)
    hit.append(run.path)
    text, errors = sweep.communicate(timeout=120)
    assert sweep.returncode == INTERRUPTED, text + errors
    assert not any(runs_on(node) for node in cluster.worker_nodes)
    assert "its Ray worker died; started again (1 of 2)" in text
    assert " is gone; started again (1 of 2)" in text
    assert "interrupted; the same command resumes it" in text

    with start_sweep(out, *arguments, RAY_ADDRESS=cluster.address) as sweep:
        text, errors = sweep.communicate(timeout=240)
    assert sweep.returncode == DONE and not errors, text + errors
    assert rows(out) == rows(tmp_path / "plain")
    for path in hit:  # none of them began at step 0 again
        config = json.loads((path / "config.json").read_text())
        assert config["resumed"] and config["device"]["cores"] == 1
    assert not [*out.glob(".*")]


@engine_test
def test_a_cluster_of_its_own_ends_with_the_sweep(tmp_path):
    sweep = start_sweep(tmp_path / "out", "--launcher=ray", "--algos=td3")
    process = psutil.Process(sweep.pid)

    def raylets():
        return [child for child in process.children(recursive=True) if "raylet" in child.name()]

    started = [*wait_for(raylets), *process.children(recursive=True)]
    sweep.kill()
    sweep.wait()
    # Two small agents of Ray's notice it a little later.
    wait_for(lambda: not any(child.is_running() and child.status() != psutil.STATUS_ZOMBIE for child in started), 180)


@engine_test
@pytest.mark.parametrize(
    ("option", "address", "line"),
    [
        ("num_gpus=1", None, "--ray=num_cpus=1,num_gpus=1: expects what a node of the cluster has; none has so much\n"),
        (
            "",
            "127.0.0.1:1",
            f"RAY_ADDRESS=127.0.0.1:1: {BELONGS}; none answers within 20 s\n",
        ),
        ("", "nonsense", "RAY_ADDRESS=nonsense: expects a Ray cluster: Invalid address format: nonsense\n"),
    ],
)
def test_what_ray_cannot_do_is_one_line(tmp_path, option, address, line):
    sweep = start_sweep(tmp_path, "--launcher=ray", f"--ray={option}", RAY_ADDRESS=address or "")
    began = time.monotonic()
    _, errors = sweep.communicate(timeout=240)
    assert sweep.returncode == BAD_USAGE and errors == line
    assert time.monotonic() - began < 60 and not [*tmp_path.iterdir()]
