"""The process that talks to Ray for a sweep: `python -m experiments.launchers.ray_driver`, started by `ray_cluster.py`.

It is a process of its own because Ray ends the driver's process where the cluster is lost and writes to its streams,
and because a terminal's signals must not reach the cluster that it starts. Input and output are a JSON object per line:
first `Settings`, then `{"submit": [[number, task, algo, path, command, detail], ...]}` and `{"cancel": true}`; answered
by `{"connected": true}`, `{"ready": true}`, `{"ended": [number, code, reason, lost]}`, and before it ends by itself
`{"refused": text}` or `{"lost": text}`. It ends with its input.
"""

import json
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from experiments.commandline.arguments import FAILED, UsageError
from experiments.launchers import ray_errors
from experiments.launchers.cell import Cell, write_ended
from experiments.launchers.local import visible_gpus
from experiments.launchers.ray_options import RayOptions, job_name
from sqt_jax.job_limits import usable_cores

WAIT_SECONDS = 0.5
CHECK_SECONDS = 120.0  # of all nodes
LOOK_SECONDS = 10.0  # between looks whether a node can still run a cell
PATIENCE_SECONDS = 120.0  # for such a node to come back
STORE_BYTES = 100 * 10**6  # of a local cluster's object store, which holds nothing of ours


class Settings(NamedTuple):
    """What the sweep says first."""

    address: str | None  # None: start a cluster on this machine
    options: dict[str, Any]  # of `RayOptions`
    expected: list[Any]  # of `Expected`
    variables: dict[str, str]  # of each cell's environment
    folder: str  # the working directory of each cell, where a machine has it
    sweep: str  # differs from all others


def main() -> None:
    """Connects, checks, and serves until the input ends."""
    output = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what Ray prints

    def tell(**message: Any) -> None:
        output.write(json.dumps(message) + "\n")

    settings = Settings(**json.loads(sys.stdin.readline()))
    inbox: queue.Queue[dict[str, Any] | None] = queue.Queue()
    reader = threading.Thread(target=_read, args=(inbox,), daemon=True)
    reader.start()
    try:
        _connect(settings.address)
        tell(connected=True)
        options = RayOptions(**settings.options).with_gpus(_has_gpus())
        check_nodes(options, settings)
        tell(ready=True)
        Tasks(options, settings, tell).serve(inbox)
    except UsageError as error:
        tell(refused=str(error))
    except ray_errors.ClusterLost as error:
        tell(lost=str(error))
    ray.shutdown()
    reader.join()  # Python cannot end while a thread reads its input


def _read(inbox: queue.Queue[dict[str, Any] | None]) -> None:
    for line in sys.stdin:
        inbox.put(json.loads(line))
    inbox.put(None)


def _connect(address: str | None) -> None:
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if not address:
        options |= {"num_cpus": usable_cores(), "include_dashboard": False, "object_store_memory": STORE_BYTES}
    try:
        ray.init(address or "local", **options)
    except Exception as error:  # of many types
        name = f"RAY_ADDRESS={address}" if address else "--launcher=ray"
        raise UsageError(f"{name}: expects a Ray cluster: {ray_errors.one_line(error)}") from None


def _has_gpus() -> bool:
    """Whether the cluster has GPUs, unless JAX is told to use none."""
    wanted = visible_gpus({"CUDA_VISIBLE_DEVICES": "0"} | {"JAX_PLATFORMS": os.environ.get("JAX_PLATFORMS", "")})
    return bool(wanted) and ray.cluster_resources().get("GPU", 0) > 0


def check_nodes(options: RayOptions, settings: Settings) -> None:
    """Raises `UsageError` if no node can run a cell, or if one that can lacks something."""
    nodes = _fitting_nodes(options)
    if not nodes:
        raise UsageError(f"--ray={options.text}: expects what a node of the cluster has; none has so much")
    task = ray.remote(_in_worker("check", settings))
    found = {}
    for node in nodes:
        strategy = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
        options_here = {"num_cpus": 0, "max_retries": 0, "scheduling_strategy": strategy}
        found[task.options(**options_here).remote(settings.expected)] = node["NodeManagerHostname"]
    ready, late = ray.wait([*found], num_returns=len(found), timeout=CHECK_SECONDS)
    for reference in [*ready, *late]:
        try:
            line = ray.get(reference, timeout=0)
        except ray.exceptions.GetTimeoutError:
            line = f"--launcher=ray: expects nodes that answer within {CHECK_SECONDS:.0f} s, unlike {found[reference]}"
        except ray.exceptions.RayError as error:
            line = f"--launcher=ray: cannot start on {found[reference]}: {ray_errors.one_line(error)}"
        if line:
            raise UsageError(line)


def _fitting_nodes(options: RayOptions) -> list[dict[str, Any]]:
    return [node for node in ray.nodes() if node["Alive"] and options.fit(node["Resources"])]


def _in_worker(name: str, settings: Settings) -> Callable[..., Any]:
    """A function of `ray_task.py` as one that Ray sends to its workers as code: they may not find the module yet."""
    folder = settings.folder
    paths = [folder, *filter(None, settings.variables.get("PYTHONPATH", "").split(os.pathsep))]

    def run_there(*arguments: Any) -> Any:
        import importlib
        import os
        import sys

        if os.path.isdir(folder):
            os.chdir(folder)
        sys.path[:0] = [path for path in paths if path not in sys.path]
        return getattr(importlib.import_module("experiments.launchers.ray_task"), name)(*arguments)

    return run_there


class Tasks:
    """The cells as tasks of Ray."""

    def __init__(self, options: RayOptions, settings: Settings, tell: Callable[..., None]):
        self._options, self._settings, self._tell = options, settings, tell
        self._train = ray.remote(_in_worker("train", settings))
        self._running: dict[ray.ObjectRef, tuple[int, Cell]] = {}
        self._cancels = 0
        self._fitted = time.monotonic()  # when a node could last run a cell
        self._looked = self._fitted

    def serve(self, inbox: queue.Queue[dict[str, Any] | None]) -> None:
        """Does what the messages ask and reports ends, until None comes. Raises `ClusterLost`."""
        while True:
            try:
                message = inbox.get(timeout=None if not self._running else 0.01)
            except queue.Empty:
                self._report()
                continue
            if message is None:
                return
            if "submit" in message:
                self._submit(message["submit"])
            else:
                self._cancel()

    def _submit(self, cells: Sequence[Sequence[Any]]) -> None:
        for number, task_name, algo, path, command, detail in cells:
            cell = Cell(task_name, algo, Path(path), tuple(command), detail)
            variables = self._settings.variables | {"SQT_JOB": job_name(self._settings.sweep, number)}
            arguments = (tuple(cell), self._settings.expected, variables)
            # Not packed on few nodes. The retries are the sweep's.
            options = {"name": cell.label, "max_retries": 0, "scheduling_strategy": "SPREAD"}
            task = self._train.options(**options, **self._options.task_options)
            reference = task.remote(*arguments, self._options.num_cpus, self._options.num_gpus)
            self._running[reference] = (number, cell)

    def _cancel(self) -> None:
        for reference in self._running:
            ray.cancel(reference, force=self._cancels > 0)
        self._cancels += 1

    def _report(self) -> None:
        done, _ = ray.wait([*self._running], num_returns=len(self._running), timeout=WAIT_SECONDS)
        for reference in done:
            number, cell = self._running.pop(reference)
            try:
                ended = ray.get(reference)
            except ray.exceptions.RayError as error:
                ended = ray_errors.ended_by(error, cell, forced=self._cancels > 1)
                if ended.lost:  # its process could not say so
                    with suppress(OSError):
                        write_ended(ended)
            self._tell(ended=[number, ended.code, ended.reason, ended.lost])
        if time.monotonic() - self._looked > LOOK_SECONDS:
            self._give_up_without_nodes()

    def _give_up_without_nodes(self) -> None:
        """Ends the cells that wait where no node has been able to run one for a while."""
        self._looked = time.monotonic()
        if _fitting_nodes(self._options):
            self._fitted = self._looked
        elif self._looked - self._fitted > PATIENCE_SECONDS:
            for number, _ in self._running.values():
                reason = f"no node of the Ray cluster has {self._options.text} any more"
                self._tell(ended=[number, FAILED, reason, False])
            self._running.clear()


if __name__ == "__main__":
    main()
