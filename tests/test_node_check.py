"""What a machine of a cluster is compared with: the shared folder, the code, the packages."""

import platform
from pathlib import Path

import pytest

from experiments.launchers import node_check
from experiments.launchers.node_check import complaint, expected_here
from experiments.running import run_config

HOST = platform.node()


def test_this_machine_has_what_it_expects(tmp_path):
    with expected_here(tmp_path / "new" / "runs") as expected:
        assert complaint(expected, "ray", seconds=0) is None
        assert Path(expected.token).is_absolute()
        assert expected.versions["jax"] == node_check.versions()["jax"] != ""
    assert not any((tmp_path / "new" / "runs").iterdir())


def test_a_machine_without_the_folder_is_named(tmp_path):
    with expected_here(tmp_path) as expected:
        pass
    line = f"--out={tmp_path}: expects a folder that all machines share; {HOST} does not see it"
    assert complaint(expected, "ray", seconds=0) == line


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"code": "0"}, f"--launcher=ray: expects the same code on all machines; {HOST} has other code in /"),
        (
            {"versions": {"jax": "0.1"}},
            f"--launcher=ray: expects jax 0.1 on all machines; {HOST} has {node_check.versions()['jax']}",
        ),
        ({"versions": {"jax": ""}}, "--launcher=ray: expects jax to be absent on all machines; "),
    ],
)
def test_other_code_and_other_packages_are_named(tmp_path, changes, line):
    with expected_here(tmp_path) as expected:
        assert complaint(expected._replace(**changes), "ray", seconds=0).startswith(line)


def test_a_package_that_is_missing_is_named(tmp_path, monkeypatch):
    with expected_here(tmp_path) as expected:
        monkeypatch.setattr(node_check, "_version", lambda name: "" if name == "brax" else expected.versions[name])
        wanted = expected.versions["brax"]
        assert complaint(expected, "x", 0) == f"--launcher=x: expects brax {wanted} on all machines; {HOST} has none"


def test_the_digest_is_of_every_source_file(tmp_path, monkeypatch):
    for package in ("a", "b"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").touch()
    monkeypatch.setattr(node_check, "CODE", ("a", "b", "absent"))
    monkeypatch.syspath_prepend(tmp_path)
    digests = [node_check.code_digest()]
    for path, text in (("b/c.py", "1"), ("b/c.py", "2"), ("b/d.txt", "2"), ("a/c.py", "2")):
        (tmp_path / path).write_text(text)
        digests.append(node_check.code_digest())
    assert digests[2] == digests[3] and len(set(digests)) == 4  # a text is no source


def test_the_packages_are_those_that_runs_record():
    assert {*node_check.PACKAGES} == {*run_config.PACKAGES} - {"sqt_jax"}
