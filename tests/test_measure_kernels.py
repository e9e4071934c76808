"""The suite kernels: its measurements; the real count where JAX's CUDA plugin is installed."""

import json
import sys

import pytest

from experiments.benchmarks import gpu_target, measure_kernels
from experiments.benchmarks.measurements import KERNELS, QUESTIONS


def test_a_case_gives_the_kernels_and_the_questions_with_their_parts():
    commands = []

    def run(command):
        commands.append(command)
        return json.dumps({"kernels": {"act": 2, "update": 40.5, "restart": 0.01}, "questions": {"restart": 1}})

    kernels, questions = measure_kernels.bench_kernels("td3", "ant", 25, "warp", run)
    assert commands == [[sys.executable, "-m", "experiments.benchmarks.measure_kernels", "td3", "ant", "warp", "25"]]
    assert kernels.what == "td3 on ant, warp (update: 40.5, act: 2)" and kernels.rate == pytest.approx(42.51)
    assert kernels.figure == ("42.5", KERNELS) and questions.figure == ("1", QUESTIONS)


def test_a_process_that_fails_is_told_by_its_last_line():
    with pytest.raises(RuntimeError, match="^the reason$"):
        measure_kernels.run_process([sys.executable, "-c", "import sys; sys.exit('first\\nthe reason')"])


@pytest.mark.slow
@pytest.mark.skipif(gpu_target.lacks_plugin(), reason="needs the extra kernels")
@pytest.mark.parametrize(("algo", "most"), [("td3_sqt", 250), ("sac_sqt", 250), ("td7_sqt", 450)])
def test_a_step_launches_at_most_so_many_kernels(algo, most):
    pytest.importorskip("warp", reason="needs the extra kernels")
    kernels, _ = measure_kernels.bench_kernels(algo, "ant", 25, "warp")
    assert 50 < kernels.rate <= most
