"""What runs inside a job: real signals, with scripts in place of a training and of SLURM's commands."""

import os
import signal
import sys
import threading
import time

import pytest

from experiments.launchers import slurm_job
from experiments.launchers.cell import Cell, read_ended
from experiments.launchers.slurm_job import MAX_IDLE_REQUEUES, CellJob, ThisJob, this_job
from experiments.running import folder_lock

SAVED = "interrupted; the same command resumes it"
SAVES = "trap 'exit 130' USR1\nwhile :; do sleep 0.02; done"
CANNOT_SAVE_YET = "true\nwhile :; do sleep 0.02; done"
HANGS = "trap '' USR1\nwhile [ ! -e go ]; do sleep 0.02; done; exit 1"


class Job:
    """A job on a machine with a `scontrol` that answers with a state, and with a script as training."""

    def __init__(self, folder, monkeypatch):
        self.folder, self.restarts = folder, 0
        self.cell = Cell("ant", "td3", folder / "run", ())
        self.token = folder / "token"
        self.token.touch()
        self.set_state("RUNNING")
        self.script("scontrol", f'case $1 in --oneliner) cat {folder}/state;; *) echo "$*" >> {folder}/calls;; esac')
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "executable", str(folder / "bin" / "training"))
        monkeypatch.setattr(slurm_job, "POLL_SECONDS", 0.02)
        monkeypatch.setenv("PATH", os.pathsep.join([str(folder / "bin"), os.environ["PATH"]]))
        for name, value in (("JOB_ID", "5"), ("ARRAY_JOB_ID", "4"), ("ARRAY_TASK_ID", "1"), ("RESTART_COUNT", "0")):
            monkeypatch.setenv(f"SLURM_{name}", value)

    def set_state(self, state, restarts=0):
        (self.folder / "state").write_text(f"JobId=5 JobState={state} Restarts={restarts}\n")

    def script(self, name, text):
        path = self.folder / "bin" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)

    @property
    def calls(self):
        """The calls of scontrol that change something."""
        file = self.folder / "calls"
        return file.read_text().splitlines() if file.exists() else []

    @property
    def ended(self):
        found = read_ended(self.cell)
        return found and found[1:]

    def run(self, training, *signals, after=lambda: None):
        """The job's exit code. Signals are sent to it, and `after` is called, when the training runs."""
        began = self.folder / "began"
        began.unlink(missing_ok=True)
        self.script("training", f"{training.splitlines()[0]}\necho $SQT_JOB > {began}\n{training}")

        def send():
            wait_until(began.exists)
            for number in signals:
                os.kill(os.getpid(), number)
            after()

        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        with pytest.raises(SystemExit) as left:
            CellJob(self.cell, self.token, "runs")()
        thread.join()
        return left.value.code


def wait_until(condition):
    give_up = time.monotonic() + 60
    while not condition() and time.monotonic() < give_up:
        time.sleep(0.01)


@pytest.fixture
def job(tmp_path, monkeypatch):
    before = {number: signal.getsignal(number) for number in (*slurm_job.STOP, *slurm_job.SAVE, signal.SIGCONT)}
    yield Job(tmp_path, monkeypatch)
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("code", [0, 1, 3])
def test_a_run_that_ends_by_itself_gives_the_job_its_exit_code(job, code):
    assert job.run(f"echo why\nexit {code}") == code
    assert job.ended == (code, "why" if code == 1 else "", False)
    assert job.calls == ["update JobId=4_1 JobName=td3-ant"]
    assert (job.folder / "began").read_text() == "slurm 4_1\n"


def test_a_run_that_is_refused_says_so_in_the_jobs_log(job, capsys):
    with folder_lock.locked(
        job.cell.path
    ):  # another process trains it: the cell's file does not say how this one ended
        assert job.run("echo '--name=run: expects another run'\nexit 2") == 2
    assert capsys.readouterr().err == "--name=run: expects another run\n" and job.ended is None


@pytest.mark.parametrize("number", slurm_job.SAVE)
@pytest.mark.parametrize("training", [SAVES, CANNOT_SAVE_YET], ids=["saves", "dies"])
def test_a_warning_saves_and_requeues(job, number, training):
    """Also if the run does not get the signal from SLURM, as with control groups."""
    assert job.run(training, number) == 130 and job.calls[1:] == ["requeue 4_1"]


@pytest.mark.parametrize("number", slurm_job.STOP)
@pytest.mark.parametrize("training", [SAVES, CANNOT_SAVE_YET], ids=["saves", "dies"])
def test_the_users_stop_is_final(job, number, training):
    assert job.run(training, number) == 130 and job.calls[1:] == [] and job.ended == (130, SAVED, False)


@pytest.mark.parametrize(
    ("state", "restarts"),
    [
        ("COMPLETING", 0),  # cancelled, or at its time limit
        ("RUNNING", 1),  # its node was thought dead, and the job runs elsewhere
        ("PENDING", 1),
    ],
)
def test_a_job_that_slurm_ends_does_not_requeue_itself(job, state, restarts):
    job.set_state(state, restarts)
    assert job.run(SAVES, signal.SIGTERM) == 130 and job.calls[1:] == [] and job.ended == (130, SAVED, True)


def test_that_a_cancelled_run_was_asked_to_save_is_known_before_it_has_saved(job):
    """SLURM may kill the job then."""
    job.set_state("COMPLETING")
    seen = []

    def let_go():
        wait_until(lambda: job.ended)
        seen.append(job.ended)
        (job.folder / "go").touch()

    assert job.run(HANGS, signal.SIGTERM, after=let_go) == 1
    assert seen == [(130, SAVED, True)] and job.ended[0] == 1


def test_a_killed_run_is_lost_and_not_requeued(job):
    assert job.run("true\nkill -9 $$") == 1 and job.calls[1:] == [] and job.ended == (1, "killed by SIGKILL", True)


def test_a_cluster_that_does_not_requeue_is_named(job, monkeypatch):
    job.script("scontrol", f"case $1 in --oneliner) cat {job.folder}/state;; *) echo 'Disabled' >&2; exit 1;; esac")
    monkeypatch.setattr(slurm_job, "REQUEUE_SECONDS", 0.0)
    assert job.run(SAVES, signal.SIGUSR2) == 130
    reason = "interrupted, and SLURM does not requeue it (Disabled); the same command resumes it"
    assert job.ended == (130, reason, True)


def test_a_job_that_is_requeued_without_progress_ends(job):
    (job.cell.path / "checkpoint" / "step_2000").mkdir(parents=True)
    (job.folder / "4_1.checkpoints").write_text("none\n" + "step_2000\n" * (MAX_IDLE_REQUEUES - 1))
    assert job.run(SAVES, signal.SIGUSR2) == 130 and job.calls[1:] == ["requeue 4_1"]
    assert job.run(SAVES, signal.SIGUSR2) == 1
    assert job.ended[1].startswith(f"requeued {MAX_IDLE_REQUEUES} times without a new checkpoint")


def test_without_the_sweeps_file_nothing_is_trained(job, capsys):
    job.token.unlink()
    with pytest.raises(SystemExit) as left:
        CellJob(job.cell, job.token, "runs")()
    printed = capsys.readouterr().err
    assert left.value.code == 2 and not job.cell.log.exists()
    assert printed.startswith("--out=runs: expects a folder that all machines share; ") and printed.count("\n") == 1


def test_the_job_is_read_from_slurms_variables():
    element = {"SLURM_JOB_ID": "5", "SLURM_ARRAY_JOB_ID": "4", "SLURM_ARRAY_TASK_ID": "1", "SLURM_RESTART_COUNT": "2"}
    assert this_job(element) == ThisJob("4_1", 2) and this_job({"SLURM_JOB_ID": "7"}) == ThisJob("7", 0)
