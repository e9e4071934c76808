"""The folder of a run's policies that is read: the run's own, else that of the newest checkpoint that can be read."""

import shutil

import pytest

from sqt_jax import policy_folders
from sqt_jax.policy_folders import PolicyFolder


@pytest.fixture
def run(tmp_path):
    """Checkpoints at 40, and before and after the evaluation of 60; the first has no best policies."""
    for name in ("step_0000000040", "step_0000000060", "step_0000000060.1"):
        for kind in ("policy", "policy_best"):
            (tmp_path / "checkpoint" / name / kind).mkdir(parents=True)
            (tmp_path / "checkpoint" / name / kind / "file").write_text(f"{kind} of {name}")
    shutil.rmtree(tmp_path / "checkpoint" / "step_0000000040" / "policy_best")
    (tmp_path / "checkpoint" / "step_0000000080.part" / "policy").mkdir(parents=True)
    return tmp_path


def read(folder):
    return (folder / "file").read_text()


def test_the_newest_checkpoint_comes_first_and_the_runs_own_before_it(run):
    assert [(found.path.parent.name, found.env_steps) for found in policy_folders.find(run)] == [
        ("step_0000000060.1", 60),
        ("step_0000000060", 60),
        ("step_0000000040", 40),
    ]
    assert len(policy_folders.find(run, best=True)) == 2
    (run / "policy").mkdir()
    assert policy_folders.find(run)[0] == PolicyFolder(run / "policy", None)
    assert policy_folders.find(run, best=True)[0].env_steps == 60


def test_if_training_removes_a_checkpoint_while_it_is_read_the_next_one_is_read(run):
    def slowly(folder):
        if folder.parent.name != "step_0000000040":
            shutil.rmtree(folder.parent)  # found, and removed before its file is opened
        return read(folder)

    text, found = policy_folders.read_first(run, False, slowly)
    assert (text, found.env_steps) == ("policy of step_0000000040", 40)


def test_a_damaged_checkpoint_is_skipped_and_a_damaged_policy_of_the_run_is_not(run):
    newest, older, _ = (found.path for found in policy_folders.find(run))
    damaged = {newest}

    def read_valid(folder):
        if folder in damaged:
            raise ValueError(f"{folder} is damaged")
        return read(folder)

    assert policy_folders.read_first(run, False, read_valid)[1].path == older
    damaged |= {found.path for found in policy_folders.find(run)}
    with pytest.raises(ValueError, match=newest.parent.name):
        policy_folders.read_first(run, False, read_valid)
    (run / "policy").mkdir()
    damaged = {run / "policy"}
    with pytest.raises(ValueError, match="policy is damaged"):
        policy_folders.read_first(run, False, read_valid)


def test_a_checkpoint_that_was_written_in_the_meantime_is_read(run):
    """With --keep_checkpoints=1 none of those that were found may be left."""

    def slowly(folder):
        newer = run / "checkpoint" / "step_0000000080"
        if not newer.exists():
            shutil.copytree(folder.parent, newer)
            for item in run.glob("checkpoint/step_*[046]0*"):
                if item != newer:
                    shutil.rmtree(item)
        return read(folder)

    assert policy_folders.read_first(run, True, slowly)[1].env_steps == 80


def test_without_a_policy_and_without_a_file_the_error_says_so(run):
    (run / "policy").mkdir()
    with pytest.raises(FileNotFoundError, match=f"{run}/policy/none"):  # of the first folder
        policy_folders.read_first(run, False, lambda folder: (folder / "none").read_text())
    shutil.rmtree(run / "checkpoint")
    with pytest.raises(FileNotFoundError, match=r"expects a run with policy_best/, .*; it has none"):
        policy_folders.read_first(run, True, read)
    assert policy_folders.is_run(run) and not policy_folders.is_run(run / "policy")


@pytest.mark.parametrize("link", ["checkpoint", "checkpoint/step_0000000060.1", "checkpoint/step_0000000060.1/policy"])
def test_links_are_not_followed(run, tmp_path_factory, link):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "moved"
    (run / link).rename(elsewhere)
    (run / link).symlink_to(elsewhere)
    assert [found.path.parent.name for found in policy_folders.find(run)] == (
        [] if link == "checkpoint" else ["step_0000000060", "step_0000000040"]
    )


def test_a_policy_that_is_a_link_to_a_file_is_not_read(run):
    (run / "checkpoint" / "step_0000000060.1" / "policy" / "more").symlink_to(run / "nothing")
    assert policy_folders.find(run)[0].path.parent.name == "step_0000000060"
