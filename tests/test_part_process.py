"""A part in a process of its own: its results arrive while it runs, and whatever ends it is one line."""

import os
import subprocess
import sys
import time

import pytest

from experiments.benchmarks import part_process
from experiments.benchmarks.kernels import Kind
from experiments.benchmarks.measurements import Failure, Measurement
from experiments.benchmarks.part_process import line, output_of, parsed, reason, results

FOUND = Measurement("loop", "a", 5, "env steps", 12.5, 3.0, kinds=(Kind("dot", 2.0, 0.5),), rates=(12.5, 13.0))


def run(program, limit=60.0):
    return results([sys.executable, "-c", program], "the part", limit, os.environ)


@pytest.mark.parametrize("found", [FOUND, Measurement("loop", "b", 1, "env steps"), Failure("a", "why")])
def test_a_result_is_the_same_after_its_way_as_a_line(found):
    assert parsed(line(found)) == found
    assert parsed("Module mujoco_warp load on device") is None


def test_the_last_line_of_a_process_or_why_it_failed():
    assert output_of([sys.executable, "-c", "print('first'); print('last')"]) == "last"
    assert output_of([sys.executable, "-c", "import os; print(os.environ['A'])"], {"A": "b"}) == "b"
    with pytest.raises(RuntimeError, match="^the reason$"):
        output_of([sys.executable, "-c", "import sys; sys.exit('first\\nthe reason')"])


def test_results_arrive_before_the_process_ends():
    began = time.monotonic()
    found = run(f"import time; print({line(FOUND)!r}, flush=True); time.sleep(60)")
    assert next(found) == FOUND and time.monotonic() - began < 30
    found.close()  # kills it


def test_a_part_that_does_not_end_keeps_its_results():
    program = f"import time; print('noise'); print({line(FOUND)!r}, flush=True); time.sleep(60)"
    assert list(run(program, 2.0)) == [FOUND, Failure("the part", "it had not ended after 2 s")]


def test_a_part_that_fails_says_why():
    assert list(run("import sys; sys.exit('first\\nlast')")) == [Failure("the part", "last")]
    assert list(run("import os; os.abort()"))[0].why == "signal 6, without an error"
    assert list(run(f"print({line(FOUND)!r})")) == [FOUND]


def test_a_killed_benchmark_leaves_no_process():
    part = "import os, time; from experiments.benchmarks import part_process as p; p.end_with_parent(0.1); "
    part += "print(os.getpid(), flush=True); time.sleep(60)"
    program = "import subprocess, sys; subprocess.Popen([sys.executable, '-c', sys.argv[1]], start_new_session=True); "
    program += "import time; time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", program, part], stdout=subprocess.PIPE, text=True) as benchmark:
        assert int(benchmark.stdout.readline()) > 0  # the part is alive
        benchmark.kill()
        began = time.monotonic()
        assert benchmark.stdout.read() == ""  # returns when the part, which has the other end, has ended
        assert time.monotonic() - began < 30


def test_xlas_fatal_message_is_the_reason_not_its_stack():
    errors = (
        "E1129 11:32:27 7 a.cc:1] other\nF1129 11:32:27 7 parse.cc:234] Unknown flag\n*** Check failure\n  @ 0x7f\n"
    )
    assert reason(errors, -6) == "Unknown flag"
    assert reason("\n", 3) == "exit code 3, without an error" and part_process.MARK not in reason(errors, -6)
