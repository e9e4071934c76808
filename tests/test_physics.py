"""The table of physics, and which of them can run on this machine."""

import types

import jax
import pytest

from sqt_jax import envs
from sqt_jax.envs import physics

GPU = types.SimpleNamespace(platform="gpu")
CPU = jax.devices("cpu")[0]


def test_every_physics_is_a_module_that_can_be_found():
    for module in physics.PHYSICS.values():
        assert physics.find_spec(module)
    assert physics.LACKS.keys() <= physics.PHYSICS.keys()


@pytest.mark.parametrize("name", ["mjx", "mujoco", "spring"])
def test_most_physics_run_anywhere(name):
    assert physics.lacks(name) == ""


def test_warp_needs_its_package(monkeypatch):
    monkeypatch.setattr(physics, "find_spec", lambda name: None)
    assert physics.lacks("warp") == "the package warp-lang (pip install -e '.[warp]')"


@pytest.mark.parametrize(
    ("first", "platforms", "missing"),
    [
        (CPU, {"cpu": [CPU]}, "an NVIDIA GPU as JAX's device, which is cpu"),
        (CPU, {"cpu": [CPU], "cuda": [GPU]}, "an NVIDIA GPU as JAX's device, which is cpu"),  # JAX_PLATFORMS=cpu,cuda
        (GPU, {"cpu": [CPU], "rocm": [GPU]}, "an NVIDIA GPU as JAX's device, which is gpu"),
        (GPU, {"cpu": [CPU], "cuda": [GPU]}, ""),
    ],
    ids=["cpu", "cpu first", "rocm", "cuda"],
)
def test_warp_needs_an_nvidia_gpu(monkeypatch, first, platforms, missing):
    def devices(platform=None):
        if platform and platform not in platforms:
            raise RuntimeError(f"Unknown backend {platform}")  # as JAX
        return platforms[platform] if platform else [first]

    monkeypatch.setattr(physics, "find_spec", lambda name: object())
    monkeypatch.setattr(jax, "devices", devices)
    assert physics.lacks("warp") == missing


def test_physics_that_cannot_run_is_rejected_in_one_line(monkeypatch):
    monkeypatch.setitem(physics.LACKS, "warp", lambda: "a part")
    with pytest.raises(ValueError, match="^physics warp needs a part$"):
        envs.make("ant", "warp")
