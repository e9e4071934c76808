"""Settings of a process, made before JAX starts: the compilation cache, one XLA option, the number of CPU devices."""

import os
from contextlib import suppress
from pathlib import Path

import jax

from sqt_jax.envs.physics.threads import usable_cores

# XLA's CPU backend compiles a loop over little data into a single function. Its default limit excludes MJX's solver
# loops, so that their many small kernels are dispatched one at a time.
SMALL_LOOPS = "xla_cpu_small_while_loop_byte_threshold"
SMALL_LOOP_BYTES = 1_000_000

DEVICES_PER_CORE = 16


def cache_directory() -> Path:
    """`JAX_COMPILATION_CACHE_DIR`, or `sqt_jax` in the user's cache folder."""
    named = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    return Path(named) if named else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sqt_jax"


def prepare() -> None:
    """Applies these settings; call before the first computation. Variables set by the user take precedence."""
    xla_flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in xla_flags:
        option = f"--xla_backend_extra_options={SMALL_LOOPS}={SMALL_LOOP_BYTES}"
        os.environ["XLA_FLAGS"] = f"{xla_flags} {option}".strip()

    set_cpu_device_count(usable_cores())
    jax.config.update("jax_compilation_cache_dir", str(cache_directory()))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def set_cpu_device_count(devices: int) -> None:
    """Makes the CPU at least `devices` XLA devices, at most 16 per core. No effect once JAX has started.

    Each device is a thread. With one device per member, members do not wait for each other, and any number of members
    is spread evenly. The gain is small (measurements: experiments/results/throughput.md).
    """
    count = min(max(devices, usable_cores()), DEVICES_PER_CORE * usable_cores())
    with suppress(RuntimeError):  # JAX has started, and keeps its devices
        jax.config.update("jax_num_cpu_devices", count)
