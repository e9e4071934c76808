"""XLA's options for GPUs: JAX knows them, and a user's own are kept."""

import os
import subprocess
import sys

from experiments.surroundings import gpu_options
from experiments.surroundings.gpu_options import with_flags


def test_further_flags_come_after_the_users():
    given = {"XLA_FLAGS": "--xla_a=1", "HOME": "/home/me"}
    assert with_flags(given, "--xla_a=2") == {"XLA_FLAGS": "--xla_a=1 --xla_a=2", "HOME": "/home/me"}
    assert with_flags({"HOME": "/home/me"}, "") == {"HOME": "/home/me"}
    assert with_flags(given, "") == given


def test_this_jax_knows_every_option():
    """XLA ends the process of a wrong name or value."""
    options = [option.flags for option in gpu_options.OPTIONS.values()]
    words = " ".join([*options, gpu_options.DETERMINISTIC, gpu_options.GRAPHS_IN_PROFILES])
    environment = {**os.environ, "XLA_FLAGS": words, "JAX_PLATFORMS": "cpu"}
    program = "import jax; print(len(jax.devices()))"
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
