"""The table of physics, and which of them can run on this machine."""

import types

import jax
import pytest

from sqt_jax import envs
from sqt_jax.envs import physics


def gpu(version):
    return [types.SimpleNamespace(platform="gpu", client=types.SimpleNamespace(platform_version=version))]


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
    ("devices", "missing"),
    [
        (jax.devices("cpu"), "an NVIDIA GPU as JAX's device, which is cpu"),
        (gpu("PJRT C API\nrocm 70100"), "an NVIDIA GPU as JAX's device, which is gpu"),
        (gpu("PJRT C API\ncuda 12090"), ""),
    ],
    ids=["cpu", "rocm", "cuda"],
)
def test_warp_needs_an_nvidia_gpu(monkeypatch, devices, missing):
    monkeypatch.setattr(physics, "find_spec", lambda name: object())
    monkeypatch.setattr(jax, "devices", lambda: devices)
    assert physics.lacks("warp") == missing


def test_physics_that_cannot_run_is_rejected_in_one_line(monkeypatch):
    monkeypatch.setitem(physics.LACKS, "warp", lambda: "a part")
    with pytest.raises(ValueError, match="^physics warp needs a part$"):
        envs.make("ant", "warp")
