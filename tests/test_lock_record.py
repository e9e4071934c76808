"""The record in the file `lock` of a run's folder."""

import json
import os

import pytest

from experiments.running import lock_record
from experiments.running.lock_record import RECORD_BYTES, Record

RECORD = Record("node7", "boot", 123, "88_2", "1", "token", 5)


@pytest.mark.parametrize(
    "record",
    [
        RECORD,
        RECORD._replace(job="", released=True),
        Record("\\" * 200, "\\" * 200, 2**63 - 1, '"' * 200, "\\" * 200, "t" * 32, 2**63 - 1, False),
    ],
)
def test_a_record_is_one_line_of_fixed_length(record):
    content = lock_record.encode(record)
    assert len(content) == RECORD_BYTES and content.endswith(b"\n") and content.count(b"\n") == 1
    assert lock_record.decode(content) == record


def changed(**fields):
    return json.dumps(RECORD._asdict() | fields).encode()


DAMAGED = [
    b"",
    b"12345\n",  # what an earlier version wrote
    b"null",
    b"[]",
    b"{}",
    b"\xff\xfe",
    b"\0" * RECORD_BYTES,
    b"[" * RECORD_BYTES,
    lock_record.encode(RECORD)[:60],
    lock_record.encode(RECORD) + b"}",
    changed(other=1),
    changed(host=7),
    changed(host="a\x1b[31m"),
    changed(job="j" * 201),
    changed(token=""),
    changed(token=None),
    changed(process=-1),
    changed(process=True),
    changed(process=1.5),
    changed(process=10**30),
    changed(beat="5"),
    changed(released=1),
]


@pytest.mark.parametrize("content", DAMAGED, ids=lambda content: repr(content)[2:22])
def test_what_is_not_a_record_is_damaged(content):
    assert lock_record.decode(content) is None


SLURM = {"SLURM_JOB_ID": "90", "SLURM_ARRAY_JOB_ID": "88", "SLURM_ARRAY_TASK_ID": "2"}


@pytest.mark.parametrize(
    ("variables", "job", "text"),
    [
        ({}, "", "host node7, process {}"),
        ({"SLURM_JOB_ID": "90"}, "90", "host node7, process {}, job 90"),
        (SLURM, "88_2", "host node7, process {}, job 88_2"),
        (SLURM | {"SQT_JOB": "ray:5"}, "ray:5", "host node7, process {}, job ray:5"),
        ({"SQT_JOB": "a\nb\u00e9" + "c" * 300}, "a?b\\xe9" + "c" * 193, "host node7, process {}, job a?b"),
    ],
)
def test_the_job_is_named_as_its_engine_names_it(variables, job, text):
    record = lock_record.new_record("node7", variables)
    assert record.job == job and len(lock_record.encode(record)) == RECORD_BYTES
    assert str(record).startswith(text.format(os.getpid()))
    assert lock_record.decode(lock_record.encode(record)) == record


@pytest.mark.parametrize(
    ("later", "earlier", "succeeds"),
    [
        ({}, {}, False),
        ({"SLURM_RESTART_COUNT": "1"}, {}, False),  # no jobs
        (SLURM | {"SLURM_RESTART_COUNT": "1"}, SLURM, True),  # requeued
        (SLURM, SLURM, False),  # a second process of the same attempt
        (SLURM | {"SLURM_RESTART_COUNT": "1"}, SLURM | {"SLURM_ARRAY_TASK_ID": "3"}, False),
        (SLURM, {}, False),
        ({"SQT_JOB": "ray:5"}, {"SQT_JOB": "ray:5"}, True),
        ({"SQT_JOB": "ray:5"}, {"SQT_JOB": "ray:6"}, False),
    ],
)
def test_a_later_attempt_at_a_job_succeeds_an_earlier_one(later, earlier, succeeds):
    later, earlier = (lock_record.new_record("h", variables) for variables in (later, earlier))
    assert later.token != earlier.token
    assert later.succeeds(earlier) == succeeds
    assert not later.succeeds(None)


def test_a_host_is_its_name_and_its_boot(monkeypatch, tmp_path):
    first, second, other = (lock_record.new_record(host) for host in ("a", "a", "b"))
    assert first.on_host_of(second) and not first.on_host_of(other)
    monkeypatch.setattr(lock_record, "BOOT_ID", tmp_path / "boot_id")
    unknown = lock_record.new_record("a")
    assert unknown.boot == ""
    (tmp_path / "boot_id").write_text("another\n")
    assert not lock_record.new_record("a").on_host_of(unknown)


def test_only_a_file_is_read(tmp_path):
    (tmp_path / "file").write_bytes(b"x" * 5000)
    content, written = lock_record.read(tmp_path / "file")
    assert content == b"x" * (RECORD_BYTES + 1) and written == (tmp_path / "file").stat().st_mtime
    (tmp_path / "link").symlink_to(tmp_path / "file")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "fifo")
    for name in ("link", "folder", "fifo", "none"):
        with pytest.raises(OSError):
            lock_record.read(tmp_path / name)
