"""What runs on the machines of a Ray cluster, in Ray's workers: the check of a machine, and the process of a cell."""

import os
import signal
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import ray

from experiments.commandline.arguments import BAD_USAGE
from experiments.launchers import node_check, node_cores
from experiments.launchers.cell import Cell, Ended
from experiments.launchers.cell_process import CellProcess

POLL_SECONDS = 0.5
SAVE_SECONDS = 20.0  # for a run whose worker is asked to end


def check(expected: Sequence[Any]) -> str | None:
    """What this machine lacks, in one line; None: nothing. `expected`: the fields of `node_check.Expected`."""
    return node_check.complaint(node_check.Expected(*expected), "ray")


def train(
    cell_fields: Sequence[Any], expected: Sequence[Any], variables: Mapping[str, str], num_cpus: int, gpus: float
) -> Ended:
    """Trains a cell in a process that dies with this worker. `ray.cancel` asks it to save and end.

    Args:
      cell_fields, expected: fields of `Cell` and `node_check.Expected`. Ray could not load the classes themselves
        before `ray_driver` has told the worker where the modules are.
      variables: of the process's environment. SQT_JOB is the same at each start of the cell (`ray_options.job_name`).
      num_cpus: how many cores it may use.
      gpus: how many GPUs Ray has given to this task; below 1: a part of one.
    """
    cell = Cell(*cell_fields)
    if line := node_check.folder_complaint(node_check.Expected(*expected)):  # a node that came later
        return Ended(cell, BAD_USAGE, line)
    assert threading.current_thread() is threading.main_thread()  # its end is what kills the process
    asked: list[int] = []
    # Ray cancels a task by interrupting its main thread. As an exception that could come between any two statements.
    before = signal.signal(signal.SIGINT, lambda number, _: asked.append(number))
    try:
        context = ray.get_runtime_context()
        own = gpu_variables(gpus, os.environ | variables)
        with node_cores.reserved_cores(num_cpus, _node_cpus(context.get_node_id())) as cores:
            return _wait(CellProcess(cell, cores, {**variables, **own}), asked)
    finally:
        signal.signal(signal.SIGINT, before)


def _wait(process: CellProcess, asked: list[int]) -> Ended:
    forwarded = 0
    try:
        while (ended := process.wait(POLL_SECONDS)) is None:
            if len(asked) > forwarded:
                forwarded = len(asked)
                process.send_signal(signal.SIGTERM)
        return ended
    except SystemExit:  # Ray's handler of SIGTERM, as `ray stop` sends it
        process.send_signal(signal.SIGTERM)
        process.wait(SAVE_SECONDS)
        raise


def _node_cpus(node_id: str) -> int:
    """How many CPUs Ray counts on a node."""
    return next((int(node["Resources"].get("CPU", 0)) for node in ray.nodes() if node["NodeID"] == node_id), 0)


def gpu_variables(gpus: float, variables: Mapping[str, str]) -> dict[str, str]:
    """Variables for a process with this number of GPUs; `variables`: those of this process."""
    if not gpus:
        return {"CUDA_VISIBLE_DEVICES": ""}  # Ray leaves all visible
    if gpus < 1 and "XLA_CLIENT_MEM_FRACTION" not in variables:
        return {"XLA_CLIENT_MEM_FRACTION": f"{0.9 * gpus:.3f}"}  # JAX takes three quarters of a GPU's memory
    return {}
