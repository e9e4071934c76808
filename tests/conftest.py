"""Shared by all tests: the cache of compiled programs, hypothesis' profile, strict promotion."""

import functools
import gc
import itertools
import os
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

# Before JAX is imported, and through the environment, so that processes started by tests share the cache.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
# Most of a test's time is compilation, and this makes it a quarter: no optimisation, the emitters of kernels that
# compile in half the time, and no parallel compilation, because two test processes keep the cores busy. `make test-all`
# sets XLA_FLAGS to nothing: programs as users compile them.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1",
)

import hypothesis  # noqa: E402
import jax  # noqa: E402
import pytest  # noqa: E402
from forked_commands import ForkedCommands  # noqa: E402

jax.config.update("jax_num_cpu_devices", 2)  # sweeps are tested over two devices too
gc.set_threshold(100_000, 50, 100)  # tracing makes many objects that live long: collecting often is a sixth of its time

# No deadline: the first example of a property compiles it. Derandomised: a run is repeatable.
hypothesis.settings.register_profile("sqt_jax", deadline=None, max_examples=40, derandomize=True)
hypothesis.settings.load_profile("sqt_jax")


@pytest.fixture(scope="module")
def strict_dtypes() -> Iterator[None]:
    """No implicit promotion between dtypes: an accidental float64 or int32 becomes an error.

    For tests of this repository's own arithmetic (`pytestmark = pytest.mark.usefixtures("strict_dtypes")`); MJX does
    not work with it.
    """
    with jax.numpy_dtype_promotion("strict"):
        yield


@pytest.fixture(scope="module")
def shared_programs() -> Iterator[None]:
    """Runs of this process with the same settings share their compiled functions: most of a tiny run is tracing.

    For modules that start many runs (`pytestmark = pytest.mark.usefixtures("shared_programs")`).
    """
    from experiments.running import session

    with pytest.MonkeyPatch.context() as patch:
        for name in ("make_trainer", "make_sweep"):
            patch.setattr(session, name, functools.cache(getattr(session, name)))
        yield


@pytest.fixture(scope="module")
def tiny_tasks() -> Iterator[None]:
    """Every task is `probe_envs.constant_reward`: complete runs of `--env=ant` in a second.

    For modules that start many runs (`pytestmark = pytest.mark.usefixtures("tiny_tasks")`).
    """
    import probe_envs

    from sqt_jax import envs

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(envs, "make", lambda *_, **__: probe_envs.constant_reward())
        yield


_ended = itertools.count(1)  # tests of this process


@pytest.fixture(autouse=True)
def _room_for_programs() -> Iterator[None]:
    """Forgets compiled programs before the process runs out of memory maps (65,530 on Linux; XLA then crashes)."""
    yield
    maps = Path("/proc/self/maps")
    if next(_ended) % 5 == 0 and maps.exists() and maps.read_text().count("\n") > 35_000:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def commands() -> Iterator[ForkedCommands]:
    """Runs commands of `experiments` in processes that share their imports: `commands.run("sweep", "--help")`."""
    with ForkedCommands() as server:
        yield server


@pytest.fixture(params=["eager", "jit"])
def maybe_jit(request):
    """A transformation that hand-worked numbers must not depend on: none, then `jax.jit`."""
    return jax.jit if request.param == "jit" else lambda function: function
