"""Trainings in processes of their own."""

import signal

import pytest

from experiments.commandline import flags
from experiments.endurance import training_process
from experiments.endurance.training_process import TASKS, Job, finish, last_line, tiny_env


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("algo", ["td3_sqt", "td7_sqt"])
def test_the_command_of_a_job_trains_in_its_folder(tmp_path, task, algo):
    job = Job(task, algo, tmp_path)
    options = flags.parse(job.command(), needs_env=task != "tiny")
    assert (options.out, options.algo, options.name) == (str(tmp_path), algo, "run")
    assert options.env == (None if task == "tiny" else task) and tiny_env().name == "tiny"
    assert job.path == tmp_path / task / algo / "run"


def test_a_process_dies_at_a_file_event(tmp_path):
    job = Job("tiny", "td3_sqt", tmp_path)
    assert finish(training_process.start(job, die_at=1)) == -signal.SIGKILL
    assert last_line(job) == "no output" and not job.path.exists()
