"""Compiles a program for an H100 that is not there: JAX's CUDA plugin is needed, a GPU or a driver is not.

XLA's autotuning needs the GPU and is off: other library calls may be chosen on a real one, in much the same number. A
program with a callback to the host cannot be compiled so.
"""

import os
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any

from experiments.surroundings.gpu_options import with_flags

PLUGINS = ("jax_cuda12_plugin", "jax_cuda13_plugin")
FLAGS = "--xla_gpu_enable_triton_gemm=false --xla_gpu_autotune_level=0"

# XLA's description of an H100 (GpuTargetConfigProto, in protobuf's text format).
H100 = """
gpu_device_info {
  threads_per_block_limit: 1024 threads_per_warp: 32 threads_per_core_limit: 2048 core_count: 132 fpus_per_core: 128
  shared_memory_per_block: 49152 shared_memory_per_block_optin: 232448 shared_memory_per_core: 233472
  registers_per_block_limit: 65536 registers_per_core_limit: 65536 l2_cache_size: 52428800
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535
  memory_bandwidth: 3352320000000 device_memory_size: 84929347584 clock_rate_ghz: 1.98
  cuda_compute_capability { major: 9 }
}
platform_name: "CUDA"
device_description_str: "NVIDIA H100 80GB HBM3"
dnn_version_info { major: 9 minor: 7 }
runtime_version { major: 12 minor: 9 patch: 0 }
"""


def lacks_plugin() -> bool:
    """Whether JAX's CUDA plugin is missing."""
    return not any(find_spec(name) for name in PLUGINS)


def environment(inherited: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Environment variables of a process that calls `compiled_text`: JAX reads them when it starts."""
    return with_flags(inherited, FLAGS) | {"JAX_PLATFORMS": "cuda,cpu", "JAX_SKIP_CUDA_CONSTRAINTS_CHECK": "1"}


def compiled_text(function: Callable, *arguments: Any, donate: int) -> str:
    """The scheduled program that XLA makes of `function` for one H100, as text.

    Args:
      arguments: trees of arrays or of `jax.ShapeDtypeStruct`.
      donate: the number of the argument whose memory is used again.
    """
    import jax  # not before `environment` applies
    from jax.experimental import topologies

    topology = topologies.get_topology_desc(platform="cuda", target_config=H100, topology="1x1x1")
    mesh = topologies.make_mesh(topology, (1,), ("device",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
    placed = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), arguments)
    return str(jax.jit(function, donate_argnums=donate).lower(*placed).compile().as_text())
