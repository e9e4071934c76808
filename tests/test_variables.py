"""The process's inherited settings (in whole commands: test_surroundings.py)."""

import pytest

from experiments.surroundings import variables


@pytest.mark.parametrize(
    ("argv", "module"),
    [
        ("python -m experiments.run --steps=1", "experiments.run"),
        ("python -um experiments.run -m other", "experiments.run"),
        ("python -u -OO -mexperiments.play RUN", "experiments.play"),
        ("python -Xdev -W error -Im experiments.tables", "experiments.tables"),
        ("python script.py", ""),
        ("python -c pass", ""),
        ("python -m", ""),
    ],
)
def test_the_module_of_a_command_line(argv, module):
    assert variables.module_of(argv.split()) == module


@pytest.mark.parametrize("home", [None, "/dev/null", "/proc/none"])
def test_a_user_without_a_home(monkeypatch, tmp_path, home):
    def unknown(uid):
        raise KeyError(uid)

    monkeypatch.setattr("pwd.getpwuid", unknown)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert variables.has_home()
    monkeypatch.delenv("HOME")
    if home:
        monkeypatch.setenv("HOME", home)
    assert not variables.has_home()
