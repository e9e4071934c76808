"""The process that talks to Ray: what it sends to workers, which nodes it accepts, when it gives up."""

import os
import queue
import subprocess
import sys

import pytest

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install '.[ray]'")

from experiments.commandline.arguments import FAILED, INTERRUPTED, UsageError  # noqa: E402
from experiments.launchers import ray_driver  # noqa: E402
from experiments.launchers.cell import Cell, Ended, read_ended  # noqa: E402
from experiments.launchers.ray_driver import Settings, Tasks, check_nodes  # noqa: E402
from experiments.launchers.ray_options import RayOptions, job_name  # noqa: E402

SETTINGS = Settings(None, {}, [], {"JAX_PLATFORMS": "cpu"}, os.getcwd(), "f00d")
SMALL = {"NodeID": "a", "Alive": True, "Resources": {"CPU": 2.0}, "NodeManagerHostname": "small"}
GONE = SMALL | {"Alive": False, "Resources": {"CPU": 8.0, "GPU": 1.0}}


class FakeRay:
    """Ray's functions, and a task of its own whose n-th call is "task n"."""

    def __init__(self):
        self.results, self.nodes, self.cancelled, self.given, self.variables = {}, [SMALL], [], [], []

    def options(self, **options):
        self.given.append(options)
        return self

    def remote(self, cell, expected, variables, *_):
        self.variables.append(variables)
        return f"task {len(self.given)}"

    def get(self, task):
        if isinstance(self.results[task], Exception):
            raise self.results[task]
        return self.results[task]


@pytest.fixture
def fake(monkeypatch):
    found = FakeRay()
    monkeypatch.setattr(ray, "remote", lambda function: found)
    monkeypatch.setattr(ray, "nodes", lambda: found.nodes)
    monkeypatch.setattr(ray, "wait", lambda tasks, **_: ([task for task in tasks if task in found.results], []))
    monkeypatch.setattr(ray, "get", found.get)
    monkeypatch.setattr(ray, "cancel", lambda task, force: found.cancelled.append((task, force)))
    return found


@pytest.fixture
def cell(tmp_path):
    return Cell("ant", "td3", tmp_path / "run", ())


def served(*messages):
    """What is told first to a sweep that sends these messages."""
    told, inbox = [], queue.Queue()
    for message in messages:
        inbox.put(message)

    def tell(**message):
        told.append(message)
        inbox.put(None)

    Tasks(RayOptions(num_gpus=0.0), SETTINGS, tell).serve(inbox)
    return told


def submitted(cell):
    return {"submit": [[5, cell.task, cell.algo, str(cell.path), cell.command, cell.detail]]}


def test_results_are_told(fake, cell):
    fake.results["task 1"] = Ended(cell, 3, "diverged")
    assert served(submitted(cell)) == [{"ended": [5, 3, "diverged", False]}]
    (options,) = fake.given
    assert options["max_retries"] == 0 and options["num_cpus"] == 1 and options["name"] == "td3 on ant"
    assert fake.variables == [{"JAX_PLATFORMS": "cpu", "SQT_JOB": job_name("f00d", 5)}]


def test_a_lost_task_is_told_and_noted_for_the_status(fake, cell):
    fake.results["task 1"] = ray.exceptions.WorkerCrashedError()
    assert served(submitted(cell)) == [{"ended": [5, FAILED, "its Ray worker died", True]}]
    assert read_ended(cell) == Ended(cell, FAILED, "its Ray worker died", True)


def test_the_second_cancel_is_by_force(fake, cell):
    cancel, error = {"cancel": True}, ray.exceptions.TaskCancelledError()
    fake.results = {"task 1": error, "task 2": error}
    assert served(submitted(cell), cancel) == [{"ended": [5, INTERRUPTED, "not started", False]}]
    assert served(submitted(cell), cancel, cancel) == [{"ended": [5, FAILED, "killed", True]}]
    assert fake.cancelled == [("task 1", False), ("task 2", False), ("task 2", True)]


def test_cells_fail_where_no_node_can_run_them_for_a_while(fake, cell, monkeypatch):
    monkeypatch.setattr(ray_driver, "LOOK_SECONDS", 0.0)
    monkeypatch.setattr(ray_driver, "PATIENCE_SECONDS", 0.0)
    fake.nodes = [GONE]
    reason = "no node of the Ray cluster has num_cpus=1 any more"
    assert served(submitted(cell)) == [{"ended": [5, FAILED, reason, False]}]


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (RayOptions(num_cpus=3), "--ray=num_cpus=3"),
        (RayOptions(num_gpus=1.0), "--ray=num_cpus=1,num_gpus=1"),
    ],
)
def test_cells_that_fit_on_no_node_are_refused(fake, options, line):
    fake.nodes = [SMALL, GONE]
    with pytest.raises(UsageError, match=f"^{line}: expects what a node of the cluster has; none has so much$"):
        check_nodes(options, SETTINGS)


@pytest.mark.parametrize(
    ("platforms", "count", "found"), [("", 2, True), ("cuda", 2, True), ("cpu", 2, False), ("", 0, False)]
)
def test_gpus_are_used_where_jax_may_and_the_cluster_has_some(monkeypatch, platforms, count, found):
    monkeypatch.setenv("JAX_PLATFORMS", platforms)
    monkeypatch.setattr(ray, "cluster_resources", lambda: {"CPU": 4.0, "GPU": count})
    assert ray_driver._has_gpus() == found


def test_a_worker_finds_the_code_of_the_sweep(tmp_path):
    """Its own path has none of it."""
    launchers = tmp_path / "code" / "experiments" / "launchers"
    launchers.mkdir(parents=True)
    (launchers / "ray_task.py").write_text("import os\ndef check(text): return f'{text} in {os.getcwd()}'\n")
    settings = SETTINGS._replace(folder=str(tmp_path), variables={"PYTHONPATH": str(tmp_path / "code")})
    sent = ray.cloudpickle.dumps(ray_driver._in_worker("check", settings))
    script = "import pickle, sys; print(pickle.load(sys.stdin.buffer)('here'))"
    command = [sys.executable, "-c", script]
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, input=sent, capture_output=True, cwd="/", env=variables)
    assert done.stdout.decode() == f"here in {tmp_path}\n", done.stderr
