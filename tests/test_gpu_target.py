"""The process that compiles for a GPU which is not there."""

import pytest

from experiments.benchmarks import gpu_target


def test_the_process_keeps_the_users_flags_of_xla():
    found = gpu_target.environment({"XLA_FLAGS": "--xla_dump_to=/tmp/x", "HOME": "/home/me"})
    assert found["XLA_FLAGS"] == f"--xla_dump_to=/tmp/x {gpu_target.FLAGS}" and found["HOME"] == "/home/me"
    assert gpu_target.environment({})["XLA_FLAGS"] == gpu_target.FLAGS
    assert gpu_target.environment({"JAX_PLATFORMS": "cpu"})["JAX_PLATFORMS"] == "cuda,cpu"


@pytest.mark.parametrize("installed", [None, "jax_cuda12_plugin", "jax_cuda13_plugin"])
def test_either_plugin_will_do(monkeypatch, installed):
    monkeypatch.setattr(gpu_target, "find_spec", lambda name: object() if name == installed else None)
    assert gpu_target.lacks_plugin() == (installed is None)
