"""XLA's options for GPUs that may make training faster: https://docs.jax.dev/en/latest/xla_flags.html

All are off. They change how kernels are launched, not what they compute. XLA joins kernels that follow one another to
a CUDA graph, which it calls a command buffer. By default a conditional may be part of one and a loop may not, so that
the GPU waits for the host at each iteration. To use an option, set the variable before the command starts:

    XLA_FLAGS='--xla_gpu_graph_min_graph_size=1' python -m experiments.run --algo=td3_sqt --env=ant

The names are those of JAX 0.10 and 0.11. XLA ends the process if it does not know an option.
"""

from collections.abc import Mapping
from typing import NamedTuple


class Option(NamedTuple):
    """A setting of XLA."""

    flags: str  # words of XLA_FLAGS
    what: str


# name -> option; `bench --suite=gpu` measures each.
OPTIONS = {
    "small_graphs": Option("--xla_gpu_graph_min_graph_size=1", "graphs of fewer than 5 kernels too"),
    # Not loops around the physics `warp`: its call has a graph of its own, which XLA cannot take into another one.
    "loops": Option("--xla_gpu_enable_command_buffer=+WHILE --xla_gpu_graph_min_graph_size=1", "loops in graphs"),
    "no_graphs": Option("--xla_gpu_enable_command_buffer=", "no graphs: what the default is worth"),
}
# The same results at each run on a GPU, and no autotuning (https://github.com/openxla/xla/pull/12520).
DETERMINISTIC = "--xla_gpu_deterministic_ops=true"
# Graphs while the profiler records; by default XLA then launches kernel by kernel.
GRAPHS_IN_PROFILES = "--xla_enable_command_buffers_during_profiling=true"


def with_flags(environment: Mapping[str, str], flags: str) -> dict[str, str]:
    """Environment variables for a process with further words of XLA_FLAGS; the last word of an option wins."""
    words = " ".join(filter(None, [environment.get("XLA_FLAGS", ""), flags]))
    return {**environment, "XLA_FLAGS": words} if words else dict(environment)
