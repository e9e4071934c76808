"""Which launcher the command line asks for."""

import sys
from pathlib import Path

import pytest

from experiments.commandline.arguments import UsageError
from experiments.launchers.choice import LAUNCHERS, LauncherOptions, check_launcher, make_launcher
from experiments.launchers.local import LocalLauncher


def options(launcher, **given):
    return LauncherOptions(
        **dict.fromkeys(LauncherOptions._fields) | {"launcher": launcher, "out": Path("runs")} | given
    )


def test_the_default_is_one_process_here():
    assert isinstance(make_launcher(options("local")), LocalLauncher)


def test_an_unknown_launcher_is_rejected():
    with pytest.raises(UsageError, match="^--launcher: expects one of local"):
        make_launcher(options("locl"))


@pytest.mark.parametrize("name", LAUNCHERS)
def test_flags_of_other_launchers_are_rejected(name):
    own = set(LAUNCHERS[name].flags)
    others = {flag for kind in LAUNCHERS.values() for flag in kind.flags} - own
    for flag in others:
        with pytest.raises(UsageError, match=f"^--{flag}: has no effect with --launcher={name}; expects "):
            make_launcher(options(name, **{flag: 1}))


def test_values_are_checked_also_where_the_launcher_cannot_be_used(monkeypatch):
    monkeypatch.setenv("PATH", "")  # no SLURM
    monkeypatch.setitem(sys.modules, "ray", None)
    check_launcher(options("slurm", slurm="time=10"))
    check_launcher(options("ray", ray="num_cpus=2"))
    with pytest.raises(UsageError, match="^--slurm: expects NAME=VALUE"):
        check_launcher(options("slurm", slurm="time"))
    with pytest.raises(UsageError, match="^--ray: expects one of num_cpus"):
        check_launcher(options("ray", ray="cpus=2"))
