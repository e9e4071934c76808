"""The suite kernels: its measurements; the real count where JAX's CUDA plugin is installed."""

import json
import sys

import pytest

from experiments.benchmarks import gpu_target, measure_kernels
from experiments.benchmarks.measurements import HOST_SYNCS, KERNELS


def test_a_case_gives_the_kernels_and_the_syncs_with_their_parts():
    commands = []

    def run(command, environment):
        commands.append(command)
        assert environment["JAX_PLATFORMS"] == "cuda,cpu"
        return json.dumps({"kernels": {"act": 2, "update": 40.5, "restart": 0.01}, "host_syncs": {"restart": 1}})

    kernels, syncs = measure_kernels.bench_kernels("td3", "ant", 25, "warp", run)
    assert commands == [[sys.executable, "-m", "experiments.benchmarks.measure_kernels", "td3", "ant", "warp", "25"]]
    assert kernels.what == "td3 on ant, warp (update: 40.5, act: 2)" and kernels.rate == pytest.approx(42.51)
    assert kernels.figure == ("42.5", KERNELS) and syncs.figure == ("1", HOST_SYNCS)


@pytest.mark.slow
@pytest.mark.skipif(gpu_target.lacks_plugin(), reason="needs the extra kernels")
@pytest.mark.parametrize(("algo", "most", "reads"), [("td3_sqt", 127, 4), ("sac_sqt", 156, 3), ("td7_sqt", 333, 6)])
def test_a_step_launches_at_most_so_many_kernels(algo, most, reads):
    """A tenth more than in experiments/results/gpu_program.md."""
    pytest.importorskip("warp", reason="needs the extra kernels")
    kernels, syncs = measure_kernels.bench_kernels(algo, "ant", 25, "warp")
    assert 50 < kernels.rate <= most and 2 <= syncs.rate <= reads
