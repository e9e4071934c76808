"""Finding runs below folders, and reading their files."""

import json
import shutil

import numpy as np
import pytest
from made_runs import write_run

from experiments.commandline.arguments import UsageError
from experiments.evidence.finished_runs import find, read_run


def test_runs_are_found_in_and_below_folders_each_once(tmp_path):
    one, two = write_run(tmp_path / "a"), write_run(tmp_path / "b", "sac")
    (one / "checkpoint").mkdir()
    shutil.copy(one / "config.json", one / "checkpoint")  # not a run of its own
    assert find([str(tmp_path)]) == ([one, two], [])
    assert find([str(two), str(tmp_path), f"{one}/"]) == ([two, one], [])


def test_folders_with_evaluations_only_are_named(tmp_path):
    one, two = write_run(tmp_path / "a"), write_run(tmp_path / "b", "sac")
    (two / "config.json").unlink()
    assert find([str(tmp_path)]) == ([one], [f"left out: {two} has an evaluations.csv but no config.json"])


def test_folders_without_a_run_are_named(tmp_path):
    path = write_run(tmp_path / "a")
    for text, message in [
        (str(tmp_path / "none"), "does not exist; RUNS expects folders of runs or folders above them"),
        (str(path / "config.json"), "is not a folder"),
    ]:
        with pytest.raises(UsageError) as error:
            find([text])
        assert message in str(error.value) and "\n" not in str(error.value)
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="contains no run"):
        find([str(tmp_path / "empty")])


def test_an_incomplete_last_line_is_dropped(tmp_path):
    path = write_run(tmp_path, curves=[[0, 1, 2]])
    table = path / "evaluations.csv"
    table.write_text(table.read_text().rstrip("\n")[:-3])
    (member,) = read_run(path)
    np.testing.assert_array_equal(member.columns["env_steps"], [0, 50])
    np.testing.assert_array_equal(member.columns["return_mean"], [0, 1])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: "", "it is empty"),
        (lambda text: text.replace("q_std", "std"), "it has no column q_std"),
        (lambda text: text.replace("value_bias", "value_bias/../x"), "'value_bias/../x' is not a column's name"),
        (lambda text: text.replace("2.0", "two"), "could not convert string to float: 'two'"),
        (lambda text: text.replace(",0.5,", ","), "line 3 has 11 fields instead of 12"),
        (lambda text: text + text.splitlines()[-1] + "\n", "member 0 has rows twice or of another seed"),
        (
            lambda text: text.replace("0,100,90,0", "0,100,90,1"),
            "member 0 has rows twice or of another seed",
        ),
        (lambda text: text.replace("0,100,90,0", "1,100,90,0"), "it has members that config.json does not have"),
        (lambda text: text.replace("0,100,90,0", "0,,90,0"), "a field of env_steps is empty"),
    ],
)
def test_damaged_evaluations_are_named(tmp_path, damage, message):
    path = write_run(tmp_path, curves=[[0, 1, 2]])
    file = path / "evaluations.csv"
    changed = damage(file.read_text())
    assert changed != file.read_text()
    file.write_text(changed)
    with pytest.raises(UsageError) as error:
        read_run(path)
    assert str(error.value) == f"{path}: its evaluations.csv is damaged: {message}"


@pytest.mark.parametrize("value", ["<script>", "warp drive", 3, ["mjx"], ""])
def test_an_impossible_physics_of_the_evaluation_is_rejected(tmp_path, value):
    path = write_run(tmp_path)
    content = json.loads((path / "config.json").read_text()) | {"evaluated_on": value}
    (path / "config.json").write_text(json.dumps(content))
    with pytest.raises(UsageError, match=r"its config.json has an invalid physics \(evaluated_on\)"):
        read_run(path)


def test_versions_are_text_that_can_be_shown(tmp_path):
    path = write_run(tmp_path, versions={"jax": "\ud800\n$x", "brax\x1b": None})
    (member,) = read_run(path)
    assert member.versions == {"jax": "\\ud800\\n$x", "brax\\x1b": "None"}


def test_runs_that_cannot_be_read_are_named(tmp_path):
    path = write_run(tmp_path)
    (path / "evaluations.csv").unlink()
    with pytest.raises(UsageError) as error:
        read_run(path)
    assert str(error.value) == f"{path}: its evaluations.csv cannot be read (No such file or directory)"
    (path / "config.json").write_text("{}")
    with pytest.raises(UsageError, match="config.json does not describe a run"):
        read_run(path)
