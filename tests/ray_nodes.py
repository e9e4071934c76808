"""A Ray cluster of several nodes on this machine, and the runs that its nodes train."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import psutil
from started_sweeps import Run


@contextmanager
def ray_nodes(number: int) -> Iterator[Any]:
    """A `ray.cluster_utils.Cluster` of a head without CPUs and `number` nodes with one each."""
    from ray.cluster_utils import Cluster

    small = {"object_store_memory": 80 * 10**6, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **small})
    try:
        for _ in range(number):
            cluster.add_node(num_cpus=1, **small)
        yield cluster
    finally:
        cluster.shutdown()


def runs_on(node: Any) -> list[Run]:
    """The runs of a node of the cluster."""
    found = []
    (raylet,) = node.all_processes["raylet"]
    with suppress(psutil.Error):
        for worker in psutil.Process(raylet.process.pid).children():
            with suppress(psutil.Error, KeyError):
                found += [Run(worker, child) for child in worker.children() if "experiments.run" in child.cmdline()]
    return found
