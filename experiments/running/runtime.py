"""What a process sets before JAX starts: the cache of compiled programs, one XLA option, the processor's devices."""

import os
from contextlib import suppress
from pathlib import Path

from sqt_jax.envs.physics.threads import usable_cores

# XLA's CPU backend compiles loops over little data into one function each. Its own limit leaves MJX's solver loops out,
# whose many small kernels are then dispatched one by one.
SMALL_LOOPS = "xla_cpu_small_while_loop_byte_threshold"
SMALL_LOOP_BYTES = 1_000_000

DEVICES_PER_CORE = 16


def cache_directory() -> Path:
    """`JAX_COMPILATION_CACHE_DIR`, or `sqt_jax` in the user's cache folder."""
    named = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    return Path(named) if named else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sqt_jax"


def prepare() -> None:
    """Call before the first computation. What the user has set in the environment stays."""
    xla_flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in xla_flags:
        option = f"--xla_backend_extra_options={SMALL_LOOPS}={SMALL_LOOP_BYTES}"
        os.environ["XLA_FLAGS"] = f"{xla_flags} {option}".strip()

    import jax

    divide_processor(usable_cores())
    jax.config.update("jax_compilation_cache_dir", str(cache_directory()))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def divide_processor(devices: int) -> None:
    """Makes the processor at least so many XLA devices, up to 16 for each core; without effect once JAX has started.

    Devices are threads that need not wait for one another. One for each member shares a sweep evenly, whatever its
    size. What that gains is in BUILD_NOTES.md, "Throughput": some of the update, next to nothing of a whole loop.
    """
    import jax

    count = min(max(devices, usable_cores()), DEVICES_PER_CORE * usable_cores())
    with suppress(RuntimeError):  # it has started, with the devices that it has
        jax.config.update("jax_num_cpu_devices", count)
