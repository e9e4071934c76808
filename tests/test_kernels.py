"""The profiler counts the operations of a loop."""

import gzip
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from experiments.benchmarks import kernels
from experiments.benchmarks.kernels import Kind


@pytest.fixture(scope="module")
def kinds():
    """A step that contains a loop over little data, which XLA makes one kernel."""

    @jax.jit
    def run(x, y, steps):
        def little(y):
            return jax.lax.fori_loop(0, 50, lambda _, y: jnp.sin(y) + y[::-1], y)

        return jax.lax.fori_loop(0, steps, lambda _, c: (jnp.sort(jnp.sin(c[0] @ c[0]), axis=0), little(c[1])), (x, y))

    x, y = jnp.eye(300), jnp.ones(4)
    jax.block_until_ready(run(x, y, 2))
    return kernels.profile(lambda steps: run(x, y, steps), 10)


def test_each_operation_of_a_step_is_counted_once(kinds):
    count = {kind.name: kind.number for kind in kinds}
    assert count["sort"] == 1 and sum(count.values()) < 10
    assert "while" not in count


def test_a_loop_that_is_one_kernel_is_an_operation(kinds):
    assert {kind.name: kind.number for kind in kinds}["call"] == 1


@pytest.mark.slow
def test_a_loop_is_one_kernel_where_runs_ask_xla_for_it():
    """With the option of `experiments.surroundings.jax_settings`; by default XLA does so only with less data."""
    program = """
import sys
from experiments.benchmarks import kernels
from experiments.surroundings import jax_settings
if sys.argv[1] == "prepared":
    jax_settings.prepare()
import jax, jax.numpy as jnp
little = lambda y: jax.lax.fori_loop(0, 50, lambda _, y: jnp.sin(y) + y[::-1], y)
run = jax.jit(lambda y, steps: jax.lax.fori_loop(0, steps, lambda _, y: jnp.sort(little(y)), y))
y = jnp.ones(2000)
jax.block_until_ready(run(y, 2))
print({kind.name: kind.number for kind in kernels.profile(lambda steps: run(y, steps), 4)}.get("call", 0.0))
"""
    root = Path(__file__).parent.parent
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    numbers = [
        float(subprocess.check_output([sys.executable, "-c", program, how], cwd=root, env=environment, text=True))
        for how in ("plain", "prepared")
    ]
    assert numbers[0] == 0 < numbers[1]


def test_the_longest_come_first(kinds):
    seconds = [kind.seconds for kind in kinds]
    assert seconds == sorted(seconds, reverse=True) and seconds[0] > 0


def event(name, start, length, thread=1):
    return {"ph": "X", "pid": 7, "tid": thread, "ts": start, "dur": length, "args": {"hlo_op": name}}


def test_an_operation_that_encloses_others_on_its_thread_is_left_out():
    events = [
        event("while", 0.0, 100.0),
        event("conditional.clone", 10.0, 30.0),
        event("call.1", 10.0, 5.0),  # a kernel
        event("dot", 15.0, 25.0),
        event("dot", 40.0, 60.0),  # one begins where the other ends
        event("call.2", 20.0, 5.0, thread=2),  # on another thread than the operation around it
        {"ph": "M", "pid": 7, "name": "process_name", "args": {"name": "a"}},
        {"ph": "X", "pid": 7, "tid": 1, "ts": 11.0, "dur": 1.0, "name": "of the host"},
    ]
    names = [found["args"]["hlo_op"] for found in kernels.innermost(events)]
    assert sorted(names) == ["call.1", "call.2", "dot", "dot"]
    assert kernels.innermost(events[-2:]) == []


def test_a_profile_that_was_cut_is_an_error(tmp_path, monkeypatch):
    path = tmp_path / "a.trace.json.gz"
    with gzip.open(path, "wt") as file:
        json.dump({"traceEvents": [event("dot", 0.0, 1.0)] * 3}, file)
    assert len(kernels._events(path)) == 3
    monkeypatch.setattr(kernels, "MAX_EVENTS", 3)
    with pytest.raises(RuntimeError, match="^the profile has 3 events, and JAX drops further ones"):
        kernels._events(path)


def test_a_line_has_the_number_of_operations_and_their_share_of_the_time():
    line = kernels.summary_line([Kind("dot", 12.0, 0.003), Kind("fusion", 30.0, 0.001)], 0.0025, most=1)
    assert line == "42 operations per step, 4.00 ms under the profiler (2.50 ms per step without): dot 75% (12)"
    assert kernels.summary_line([], 0.0025) == "the profile has no operations"
