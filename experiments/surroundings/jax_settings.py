"""JAX's settings in a command's process, made before JAX starts: switches, compilation cache, devices."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import jax
from jax.extend.backend import clear_backends

from experiments.commandline.arguments import UsageError
from experiments.surroundings import paths, variables
from sqt_jax.job_limits import usable_cores

# XLA's CPU backend compiles a loop over little data into a single function. Its default limit excludes MJX's solver
# loops, so that their many small kernels are dispatched one at a time.
SMALL_LOOPS = "xla_cpu_small_while_loop_byte_threshold"
SMALL_LOOP_BYTES = 1_000_000

DEVICES_PER_CORE = 16

# Switches of JAX with which a run would fail or draw other random numbers, and the values it needs.
NEEDED = {
    "jax_enable_x64": False,  # training is in float32
    "jax_default_prng_impl": "threefry2x32",
    "jax_threefry_partitionable": True,
    "jax_random_seed_offset": 0,
    "jax_legacy_prng_key": "allow",
    "jax_numpy_dtype_promotion": "standard",
    "jax_numpy_rank_promotion": "allow",
    "jax_debug_key_reuse": False,
    "jax_check_tracer_leaks": False,
    "jax_no_tracing": False,
    "jax_no_execution": False,
    "jax_raise_persistent_cache_errors": False,
    "jax_error_checking_behavior_nan": "ignore",
    "jax_error_checking_behavior_divide": "ignore",
    "jax_error_checking_behavior_oob": "ignore",
    "jax_transfer_guard_host_to_device": "allow",
    "jax_transfer_guard_device_to_host": "allow",
}
# Switches that cannot be ignored, since the user asks for something else than training: what to do instead.
REFUSED = {
    "jax_debug_nans": "a NaN here is a metric that was not measured; a member that diverges is reported without it",
    "jax_debug_infs": "infinity is a value of our own bounds; a member that diverges is reported without it",
    "jax_disable_jit": "training is one compiled loop; to debug an update, call `agent.update` under jax.disable_jit()",
}


@contextmanager
def needed_switches() -> Iterator[None]:
    """JAX with the switches that a run needs; afterwards they are the caller's again.

    Raises:
      UsageError: a switch is on that a run cannot support.
    """
    values = jax.config.values
    for name, instead in REFUSED.items():
        if values.get(name):
            raise UsageError(f"{name.upper()}: expects it to be off: {instead}")
    # None: not set, as good as allowed. A version of JAX may lack a switch.
    before = {name: values[name] for name, needed in NEEDED.items() if values.get(name) not in (None, needed)}
    if before:
        names = ", ".join(map(str.upper, before))
        print(f"{names}: has no effect on a run, which needs JAX's default", file=sys.stderr)
    try:
        for name in before:
            jax.config.update(name, NEEDED[name])
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def prepare() -> None:
    """Applies the settings of a process; call before its first computation. The user's variables win."""
    xla_flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in xla_flags:
        option = f"--xla_backend_extra_options={SMALL_LOOPS}={SMALL_LOOP_BYTES}"
        os.environ["XLA_FLAGS"] = f"{xla_flags} {option}".strip()
    _set_cpu_device_count(usable_cores())
    cache = _cache()
    jax.config.update("jax_compilation_cache_dir", cache)
    if cache is None:
        jax.config.update("jax_enable_compilation_cache", False)
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def start_jax(devices: int) -> None:
    """Starts JAX with at least this number of CPU devices, at most 16 per core; no effect if it has started.

    Each device is a thread. With one device per member, members do not wait for each other, and any number of members
    is spread evenly. The gain is small (measurements: experiments/results/throughput.md). A number of devices that the
    user has set is kept.

    Raises:
      UsageError: the user's variables name a platform that JAX does not have here.
    """
    _set_cpu_device_count(devices)
    try:
        jax.local_devices()
    except Exception as error:  # of several types
        wanted = jax.config.values["jax_platforms"]
        if not wanted:
            raise
        reason = " ".join(str(error).split())[:150]
        clear_backends()
        jax.config.update("jax_platforms", "")
        here = jax.default_backend()
        jax.config.update("jax_platforms", wanted)
        raise UsageError(
            f"JAX_PLATFORMS={wanted}: expects a platform of this machine, as {here}" + (f"; {reason}" if reason else "")
        ) from None


def cache_directory() -> str | None:
    """The folder of compiled programs: `JAX_COMPILATION_CACHE_DIR`, or `sqt_jax` in the user's cache folder.

    None: there is no such folder.

    Raises:
      ValueError: a variable names a home folder that does not exist.
    """
    if named := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return paths.expanded(named)
    if named := os.environ.get("XDG_CACHE_HOME"):
        return str(Path(paths.expanded(named)) / "sqt_jax")
    return str(Path.home() / ".cache" / "sqt_jax") if variables.has_home() else None


def _cache() -> str | None:
    """`cache_directory` if it can be written; else None, and a warning."""
    try:
        directory = cache_directory()
        if directory is None:
            problem = "the user has no home folder"
        elif "://" in directory:  # in the cloud
            return directory
        else:
            Path(directory).mkdir(parents=True, exist_ok=True)
            if os.access(directory, os.W_OK | os.X_OK):
                return directory
            problem = f"{directory} cannot be written"
    except (OSError, ValueError) as error:
        problem = str(error)
    hint = "JAX_COMPILATION_CACHE_DIR names another folder"
    print(f"compiled programs are not kept for the next run: {problem}; {hint}", file=sys.stderr)
    return None


def _set_cpu_device_count(devices: int) -> None:
    by_user = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if by_user or os.environ.get("JAX_NUM_CPU_DEVICES"):
        return
    count = min(max(devices, usable_cores()), DEVICES_PER_CORE * usable_cores())
    with suppress(RuntimeError):  # JAX has started, and keeps its devices
        jax.config.update("jax_num_cpu_devices", count)
