"""What a run says of its environments on the host. The runs themselves are in test_host_runs.py."""

import jax
import numpy as np
from host_tasks import Counter

from experiments.running import environment_errors
from sqt_jax.envs.gym_ids import from_gymnasium
from sqt_jax.types import HostError


def test_the_traceback_is_written_whatever_is_in_it(tmp_path):
    error = HostError("OSError: x", "line 1\nOSError: \udcff")
    assert environment_errors.write_error(tmp_path, tmp_path, error) == f"traceback: {tmp_path / 'error.txt'}"
    assert (tmp_path / "error.txt").read_text() == "line 1\nOSError: \\udcff"
    missing = tmp_path / "missing"
    text = environment_errors.write_error(missing, missing, error)
    assert text.startswith("the traceback cannot be written: FileNotFoundError: ")


def test_steps_that_are_not_finite_are_counted_over_members_and_environments():
    env = from_gymnasium("counter", Counter, 5)
    timestep = jax.eval_shape(env.reset, jax.random.key(0))

    def line(steps, starts):
        state = timestep.state._replace(unstable=np.array(steps), unstable_starts=np.array(starts))
        return environment_errors.unstable_steps(env, timestep._replace(state=state))

    expected = "1 steps and 7 starts of counter had an observation, reward or action that is not finite"
    assert line([[0, 1], [0, 0]], [[3, 0], [4, 0]]).startswith(expected)
    assert line([[0, 0]], [[0, 0]]) == ""
