"""SLURM's commands, with scripts in their place."""

import os

import pytest

from experiments.launchers import slurm_queue
from experiments.launchers.slurm_queue import CommandError, Job


@pytest.fixture
def commands(tmp_path, monkeypatch):
    """Makes scripts that write down their arguments, and returns what was written."""
    written = tmp_path / "written"

    def make(name, script):
        path = tmp_path / "bin" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f'#!/bin/sh\necho "${{0##*/}} $*" >> {written}\n{script}\n')
        path.chmod(0o755)
        return lambda: written.read_text().splitlines()

    monkeypatch.setenv("PATH", os.pathsep.join([str(tmp_path / "bin"), os.environ["PATH"]]))
    return make


def test_jobs_and_elements_of_arrays_are_read():
    jobs = slurm_queue.read_jobs("7|PENDING|Resources|n/a\n12_3|RUNNING|None|n1\n\nno job\n")
    assert jobs == {"7": Job("PENDING", "Resources", "n/a"), "12_3": Job("RUNNING", "None", "n1")}


@pytest.mark.parametrize(
    ("state", "over"),
    [
        *(("PENDING", False), ("RUNNING", False), ("SUSPENDED", False)),
        ("COMPLETING", False),  # it may be requeued
        *(("COMPLETED", True), ("FAILED", True), ("CANCELLED", True), ("TIMEOUT", True), ("NODE_FAIL", True)),
    ],
)
def test_states_that_are_an_end(state, over):
    assert Job(state, "None", "n1").over == over


def test_one_question_asks_for_all_jobs_also_ended_ones(commands):
    written = commands("squeue", "echo '1_0|FAILED|None|n1'")
    assert slurm_queue.jobs() == {"1_0": Job("FAILED", "None", "n1")}
    assert written() == [f"squeue --noheader --array --states=all --user={os.getuid()} --format=%i|%T|%r|%B"]


def test_the_state_of_one_job(commands):
    commands("scontrol", "echo 'JobId=2 ArrayJobId=1 JobState=RUNNING Reason=None Requeue=1 Restarts=3 ExitCode=0:0'")
    assert slurm_queue.state_and_restarts("1_0") == ("RUNNING", 3)
    commands("scontrol", "echo nothing")
    with pytest.raises(CommandError, match="^scontrol: nothing$"):
        slurm_queue.state_and_restarts("1_0")


def test_signals_go_to_the_step_and_cancels_to_the_job(commands):
    written = commands("scancel", "")
    slurm_queue.send("USR1", ["1_0", "1_1"])
    slurm_queue.cancel(["1_2"])
    slurm_queue.kill(["1_3"])
    assert written() == [
        "scancel --signal=USR1 1_0.0 1_1.0",
        "scancel 1_2",
        "scancel --full --signal=KILL 1_3",
    ]


def test_the_error_of_a_command_is_one_line(commands, monkeypatch):
    commands("scontrol", "echo 'first' >&2; echo 'second' >&2; exit 1")
    with pytest.raises(CommandError, match="^first; second$"):
        slurm_queue.requeue("1")
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(CommandError, match="^squeue: FileNotFoundError"):
        slurm_queue.jobs()
