"""--launcher=slurm with stand-ins for SLURM: what is submitted, how an end is known, how jobs are stopped."""

import shutil
import sys

import pytest

from experiments.commandline.arguments import UsageError
from experiments.launchers import slurm, slurm_queue, slurm_records
from experiments.launchers.cell import Cell, Ended, write_ended
from experiments.launchers.slurm import POLL_SECONDS, SHARING_SECONDS, SlurmLauncher, outcome
from experiments.launchers.slurm_queue import CommandError, Job
from experiments.launchers.slurm_records import Submitted

SAVED = "interrupted; the same command resumes it"


class Slurm:
    """A SLURM of which the test says what it answers, and a clock that only sleeping moves."""

    def __init__(self, folder):
        self.folder, self.now = folder, 100.0
        self.queue, self.calls, self.arrays = {}, [], []
        self.broken = None

    def jobs(self):
        if self.broken:
            raise CommandError(self.broken)
        return {job: Job(state, "None", "n1") for job, state in self.queue.items()}

    def array(self, cells):
        if self.broken:
            raise UsageError(self.broken)
        number = len(self.arrays) + 1
        self.arrays.append([cell.algo for cell in cells])
        jobs = [f"{number}_{index}" for index in range(len(cells))]
        self.queue |= dict.fromkeys(jobs, "PENDING")
        return [Submitted(job, self.log(job)) for job in jobs]

    def log(self, job):
        return self.folder / f"{job}.log"

    def start(self, *jobs):
        for job in jobs:
            self.queue[job] = "RUNNING"
            self.log(job).touch()

    def launcher(self):
        def sleep(seconds):
            self.now += seconds

        return SlurmLauncher(self.folder, self.array, clock=lambda: self.now, sleep=sleep)

    def next_poll(self, launcher):
        """What `ended` says when SLURM is asked next."""
        found = []
        for _ in range(int(POLL_SECONDS) + 1):
            found += launcher.ended()
        return found


@pytest.fixture
def fake(tmp_path, monkeypatch):
    made = Slurm(tmp_path)
    monkeypatch.setattr(slurm_queue, "jobs", made.jobs)
    for name in ("send", "cancel", "kill"):
        monkeypatch.setattr(slurm_queue, name, lambda *call, name=name: made.calls.append((name, *call)))
    return made


@pytest.fixture
def cells(tmp_path):
    return [Cell("ant", algo, tmp_path / "ant" / algo / "x", ()) for algo in ("td3", "sac", "td7")]


def test_a_grid_is_one_array_and_a_lost_cell_a_job_of_its_own(fake, cells):
    launcher = fake.launcher()
    launcher.submit(cells)
    launcher.submit(cells[1:2])  # its job still waits
    assert fake.arrays == [["td3", "sac", "td7"]]
    fake.queue["1_1"] = "FAILED"
    launcher.submit(cells[1:2])
    assert fake.arrays == [["td3", "sac", "td7"], ["sac"]] and slurm_records.read(cells[1]).job == "2_0"


def test_a_cell_ends_when_its_job_is_over(fake, cells):
    launcher = fake.launcher()
    launcher.submit(cells)
    fake.start("1_0", "1_1", "1_2")
    write_ended(Ended(cells[0], 0, ""))
    assert fake.next_poll(launcher) == []  # the job may still requeue itself
    fake.queue |= {"1_0": "COMPLETING", "1_1": "PENDING"}  # the second one was requeued
    assert fake.next_poll(launcher) == []
    fake.queue["1_0"] = "COMPLETED"
    assert fake.next_poll(launcher) == [Ended(cells[0], 0, "")]
    del fake.queue["1_2"]  # SLURM has forgotten it
    write_ended(Ended(cells[2], 3, ""))
    assert fake.next_poll(launcher) == [Ended(cells[2], 3, "")]


def test_what_an_earlier_job_left_is_no_end(fake, cells):
    cells[0].path.parent.mkdir(parents=True)
    write_ended(Ended(cells[0], 1, "an earlier failure"))
    launcher = fake.launcher()
    launcher.submit(cells[:1])
    assert not cells[0].ended_file.exists()


def test_a_job_without_a_word_is_lost_when_its_files_had_time_to_appear(fake, cells):
    launcher = fake.launcher()
    launcher.submit(cells[:1])
    fake.start("1_0")
    fake.log("1_0").write_text("srun: error: n1: task 0: Killed\n")
    fake.queue["1_0"] = "FAILED"
    began = fake.now
    assert fake.next_poll(launcher) == []
    del fake.queue["1_0"]  # forgotten while the files are awaited
    while not (found := fake.next_poll(launcher)):
        assert fake.now < began + 3 * SHARING_SECONDS
    assert fake.now >= began + SHARING_SECONDS
    assert found == [Ended(cells[0], 1, "job 1_0 was lost (FAILED): srun: error: n1: task 0: Killed", lost=True)]


def test_slurm_is_asked_every_few_seconds_and_may_be_silent(fake, cells, monkeypatch):
    launcher = fake.launcher()
    launcher.submit(cells)
    asked = []
    monkeypatch.setattr(slurm_queue, "jobs", lambda: asked.append(fake.now) or fake.jobs())
    for _ in range(4 * int(POLL_SECONDS)):
        launcher.ended()
    assert len(asked) <= 5
    fake.broken = "squeue: Unable to contact slurm controller"
    assert fake.next_poll(launcher) == []


def test_an_error_at_the_start_is_raised_and_later_costs_one_cell(fake, cells):
    fake.broken = "--slurm: expects options that sbatch accepts: sbatch: error: Socket timed out"
    with pytest.raises(UsageError, match="Socket timed out$"):
        fake.launcher().submit(cells)
    fake.broken = None
    launcher = fake.launcher()
    launcher.submit(cells[:2])
    fake.broken = "Socket timed out"
    launcher.submit(cells[2:])
    fake.broken = None
    assert launcher.ended() == [Ended(cells[2], 1, "Socket timed out", lost=True)]


def test_a_full_disk_ends_a_launcher_that_begins_and_costs_a_later_one_a_cell(fake, cells, monkeypatch):
    def full(cells):
        raise OSError(28, "No space left on device")

    launcher = fake.launcher()
    launcher.submit(cells[:2])
    fake.array = full
    with pytest.raises(OSError, match="No space"):
        fake.launcher().submit(cells[2:])
    monkeypatch.setattr(launcher, "_array", full)
    launcher.submit(cells[2:])
    assert launcher.ended() == [Ended(cells[2], 1, "[Errno 28] No space left on device", lost=True)]


def test_jobs_of_an_earlier_command_are_awaited(fake, cells):
    fake.launcher().submit(cells)  # left, or killed
    fake.queue["1_2"] = "CANCELLED"
    launcher = fake.launcher()
    launcher.submit(cells)
    assert fake.arrays[1:] == [["td7"]] and [*launcher.already_queued] == cells[:2]
    write_ended(Ended(cells[0], 0, ""))
    fake.queue["1_0"] = "COMPLETED"
    assert fake.next_poll(launcher) == [Ended(cells[0], 0, "")]


def test_cancel_saves_running_jobs_and_drops_waiting_ones(fake, cells):
    with fake.launcher() as launcher:
        launcher.submit(cells)
        fake.start("1_0", "1_1")
        launcher.cancel()
        assert launcher.ended() == []
        assert fake.calls == [("cancel", ["1_2"]), ("send", "USR1", ["1_0"]), ("send", "USR1", ["1_1"])]
        write_ended(Ended(cells[0], 130, SAVED))
        # The second had no program yet that could save: it is asked again, and the next signal ends it.
        fake.queue |= {"1_0": "FAILED", "1_2": "CANCELLED"}
        assert fake.next_poll(launcher) == [
            Ended(cells[0], 130, SAVED),
            Ended(cells[2], 130, "job 1_2 was cancelled before it started"),
        ]
        assert fake.calls[-1] == ("send", "USR1", ["1_1"])
        fake.queue["1_1"] = "FAILED"
        (ended,) = fake.next_poll(launcher)
        assert ended.cell == cells[1] and ended.lost
    assert not [call for call in fake.calls if call[0] == "kill"]


def test_a_second_cancel_ends_jobs_at_once(fake, cells):
    launcher = fake.launcher()
    launcher.submit(cells)
    fake.start("1_0")
    launcher.cancel()
    launcher.cancel()
    assert [ended.code for ended in launcher.ended()] == [130, 130, 130]
    assert fake.calls[-2:] == [("kill", ["1_0", "1_1", "1_2"]), ("cancel", ["1_0", "1_1", "1_2"])]


def test_an_error_of_the_sweep_leaves_no_job_behind(fake, cells):
    with pytest.raises(OSError), fake.launcher() as launcher:
        launcher.submit(cells)
        raise OSError
    assert [call[0] for call in fake.calls] == ["kill", "cancel"]


CANCELLED, FAILED, TIMEOUT = (Job(state, "None", "n1") for state in ("CANCELLED", "FAILED", "TIMEOUT"))


@pytest.mark.parametrize(
    ("job", "ended", "lost"),
    [
        (TIMEOUT, Ended(None, 130, SAVED, lost=True), True),  # submitted again, and resumes
        (CANCELLED, Ended(None, 130, SAVED, lost=True), False),  # by a user: stays so
        (CANCELLED, Ended(None, 1, "killed by SIGKILL", lost=True), True),
        (FAILED, Ended(None, 130, SAVED), False),
        (None, Ended(None, 1, "killed by SIGKILL", lost=True), True),
    ],
)
def test_a_user_who_cancels_a_job_means_it(cells, tmp_path, job, ended, lost):
    cells[0].path.parent.mkdir(parents=True)
    write_ended(ended._replace(cell=cells[0]))
    found = outcome(cells[0], job, Submitted("1_0", tmp_path / "log"), tmp_path, waited=False)
    assert found == ended._replace(cell=cells[0], lost=lost)


@pytest.mark.parametrize(
    "line",
    [
        "--launcher=slurm: expects the folder /x on all machines; n1 does not have it",
        "--resume=runs/ant/td3/x: host n1, process 5 is training runs/ant/td3/x; expects another run",
    ],
)
def test_a_job_that_refuses_is_not_started_again(cells, tmp_path, line):
    log = tmp_path / "log"
    log.write_text(f"Traceback\n{line}\nsrun: x\n")
    assert outcome(cells[0], FAILED, Submitted("1_0", log), tmp_path, waited=False) == Ended(cells[0], 2, line)


def test_a_machine_that_does_not_see_the_folder_is_named(cells, tmp_path):
    """SLURM cannot write the job's log there, and ends the job before it begins."""
    ended = outcome(cells[0], FAILED, Submitted("1_0", tmp_path / "log"), tmp_path, waited=True)
    text = f"--out={tmp_path}: expects a folder that all machines share; n1 does not see it (job 1_0: FAILED)"
    assert ended == Ended(cells[0], 2, text)


def test_without_slurm_or_submitit_one_line_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None if name == "sbatch" else f"/bin/{name}")
    monkeypatch.setitem(sys.modules, "submitit", sys)
    with pytest.raises(UsageError, match="^--launcher=slurm: expects SLURM's commands .* no sbatch$"):
        slurm.make(tmp_path, None, None, None)
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(UsageError, match=r"^--launcher=slurm: expects the package submitit; pip install 'sqt_jax\[sl"):
        slurm.make(tmp_path, None, None, None)
    with pytest.raises(UsageError, match="^--out=.*: expects a path without %"):
        slurm.make(tmp_path / "100%", None, None, None)
    with pytest.raises(UsageError, match="^--slurm: expects NAME=VALUE"):
        slurm.make(tmp_path, None, "gpu", None)
