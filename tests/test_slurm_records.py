"""Which job of SLURM trains a cell."""

import pytest

from experiments.launchers import slurm_queue, slurm_records
from experiments.launchers.cell import Cell
from experiments.launchers.slurm_queue import Job
from experiments.launchers.slurm_records import Submitted


@pytest.fixture
def cells(tmp_path):
    return [Cell("ant", "td3", tmp_path / name, ()) for name in "abc"]


def test_what_is_written_is_read(cells, tmp_path):
    submitted = Submitted("12_3", tmp_path / "log")
    slurm_records.write(cells[0], submitted)
    assert slurm_records.read(cells[0]) == submitted and slurm_records.read(cells[1]) is None


@pytest.mark.parametrize("content", ["", "{}", '{"slurm": 12, "log": "x"}', '{"slurm": "--all", "log": "x"}', "[1]"])
def test_a_damaged_file_is_no_job(cells, content):
    cells[0].job_file.write_text(content)
    assert slurm_records.read(cells[0]) is None


def test_slurm_is_asked_only_if_there_was_a_job(cells, monkeypatch):
    monkeypatch.setattr(slurm_queue, "jobs", lambda: pytest.fail("there was none"))
    assert slurm_records.in_queue(cells) == {}


def test_jobs_that_wait_or_run_are_in_the_queue(cells, monkeypatch, tmp_path):
    jobs = {"1_0": Job("RUNNING", "None", "n1"), "1_1": Job("COMPLETED", "None", "n1")}
    for number, cell in enumerate(cells):  # SLURM has forgotten the last one
        slurm_records.write(cell, Submitted(f"1_{number}", tmp_path / "log"))
    monkeypatch.setattr(slurm_queue, "jobs", lambda: jobs)
    assert slurm_records.in_queue(cells) == {cells[0]: (Submitted("1_0", tmp_path / "log"), jobs["1_0"])}
