"""Runs are checked before a tuning asks for anything."""

import json

import pytest

from experiments.running import memory
from experiments.tuning import check_runs

pytestmark = pytest.mark.usefixtures("tiny_tasks")

RUN = ("--algo=td3_sqt", "--env=ant", "--steps=60", "--warmup_steps=20", "--batch_size=8", "--hidden=8", "--seeds=0,1")


def check(capsys, *more, workers=1):
    code = check_runs.main(["check_runs", str(workers), json.dumps([("--batch=2", [*RUN, *more])])])
    return code, *capsys.readouterr()


def test_a_run_that_can_be_trained_prints_its_environment(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert check(capsys) == (0, '["ant", "ant"]\n', "")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        (
            "--warmup_steps=60",
            "--warmup_steps: expects fewer than the run's steps (60), not 60: nothing would be learned\n",
        ),
        ("--temperature=0.1", "--temperature: has no effect with td3_sqt\n"),
        ("--physics=warp", "--physics: warp needs "),
    ],
)
def test_settings_that_no_run_takes_are_one_line(capsys, flag, message):
    code, _, error = check(capsys, flag)
    assert code == 2 and error.startswith(message) and error.count("\n") == 1


def test_members_that_do_not_fit_are_one_line_that_names_the_batch(capsys, monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda devices: (1_000, "here"))
    code, _, error = check(capsys)
    assert code == 2
    assert error == (
        "--batch=2: 2 members need about 0.0 GB, 0.0 GB are free here; expects a smaller number, fewer --seeds or a "
        "smaller --replay_capacity\n"
    )


def test_runs_side_by_side_need_their_memory_together(capsys, monkeypatch):
    needed = []
    estimate = memory.memory_estimate
    monkeypatch.setattr(memory, "memory_estimate", lambda *given: needed.append(estimate(*given)) or needed[-1])
    monkeypatch.setattr(memory, "free_memory", lambda devices: (int(2.5 * needed[-1]), "here"))
    assert check(capsys, workers=2)[0] == 0
    code, _, error = check(capsys, workers=3)
    assert code == 2 and error.startswith("--batch=2: 3 runs of 2 members need about ")
