"""What a loop runs is counted by the profiler."""

import jax
import jax.numpy as jnp
import pytest

from experiments import kernels
from experiments.kernels import Kind


@pytest.fixture(scope="module")
def kinds():
    @jax.jit
    def run(x, steps):
        return jax.lax.fori_loop(0, steps, lambda _, x: jnp.sort(jnp.sin(x @ x), axis=0), x)

    x = jnp.eye(300)
    jax.block_until_ready(run(x, 2))
    return kernels.profile(lambda steps: run(x, steps), 10)


def test_each_operation_of_a_step_is_counted_once(kinds):
    count = {kind.name: kind.number for kind in kinds}
    assert count["sort"] == 1 and sum(count.values()) < 10
    assert not count.keys() & set(kernels.CONTAINERS)


def test_those_that_take_longest_come_first(kinds):
    seconds = [kind.seconds for kind in kinds]
    assert seconds == sorted(seconds, reverse=True) and seconds[0] > 0


def test_a_line_tells_how_many_and_where_the_time_goes():
    line = kernels.told([Kind("dot", 12.0, 0.003), Kind("fusion", 30.0, 0.001)], most=1)
    assert line == "42 operations a step, 4.00 ms: dot 75% (12)"
