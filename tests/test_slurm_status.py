"""What SLURM says of the cells of a grid."""

import pytest

from experiments.launchers import slurm_queue, slurm_records
from experiments.launchers.cell import Cell, Ended, write_ended
from experiments.launchers.slurm_queue import CommandError, Job
from experiments.launchers.slurm_records import Submitted
from experiments.launchers.slurm_status import job_texts


@pytest.fixture
def cells(tmp_path):
    made = [Cell("ant", "td3", tmp_path / name, ()) for name in "abcdef"]
    for number, cell in enumerate(made[:5]):
        (tmp_path / f"log{number}").touch()
        slurm_records.write(cell, Submitted(f"1_{number}", tmp_path / f"log{number}"))
    return made


def test_each_job_has_a_word_and_a_text(cells, monkeypatch, tmp_path):
    jobs = {
        "1_0": Job("PENDING", "Resources", "n/a"),
        "1_1": Job("RUNNING", "None", "n1"),
        "1_2": Job("FAILED", "NonZeroExitCode", "n1"),
        "1_4": Job("FAILED", "NonZeroExitCode", "n1"),
    }
    monkeypatch.setattr(slurm_queue, "jobs", lambda: jobs)
    (tmp_path / "log2").write_text("--launcher=slurm: expects x on all machines; n1 does not have it\n")
    write_ended(Ended(cells[4], 1, "the run's own error"))
    assert job_texts(cells, tmp_path) == {
        cells[0]: ("waiting", "job 1_0 (Resources)"),
        cells[1]: ("running", "job 1_1"),
        cells[2]: ("failed", "--launcher=slurm: expects x on all machines; n1 does not have it"),
        cells[3]: ("interrupted", "job 1_3 was lost (forgotten by SLURM): it printed nothing"),
    }  # of the fifth the run's files say how it ended, and the sixth never had a job


def test_without_slurm_there_are_only_the_runs_files(cells, monkeypatch, tmp_path):
    def fail():
        raise CommandError("squeue: not here")

    monkeypatch.setattr(slurm_queue, "jobs", fail)
    assert job_texts(cells, tmp_path) == {}
    monkeypatch.setattr(slurm_queue, "jobs", lambda: pytest.fail("no cell ever had a job"))
    assert job_texts(cells[5:], tmp_path) == {}
