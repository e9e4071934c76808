"""The launcher that the command line asks for."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from experiments.commandline.arguments import UsageError
from experiments.launchers import local, ray_cluster, ray_options, slurm, slurm_options
from experiments.launchers.launcher import Launcher
from sqt_jax.suggestions import expects_one_of


class LauncherOptions(NamedTuple):
    """The flags of all launchers; None: not given."""

    launcher: str
    out: Path
    workers: int | None = None  # local
    max_jobs: int | None = None  # slurm
    slurm: str | None = None  # slurm
    slurm_setup: str | None = None  # slurm
    detach: bool | None = None  # slurm
    ray: str | None = None  # ray


class Kind(NamedTuple):
    """One launcher: how it is made, and the fields of `LauncherOptions` that it reads."""

    make: Callable[[LauncherOptions], Launcher]
    flags: tuple[str, ...]
    check: Callable[[LauncherOptions], object] = lambda options: None  # their values


LAUNCHERS = {
    "local": Kind(lambda options: local.make(options.workers or 1), ("workers",)),
    "slurm": Kind(
        lambda options: slurm.make(options.out, options.max_jobs, options.slurm, options.slurm_setup),
        ("max_jobs", "slurm", "slurm_setup", "detach"),
        lambda options: slurm_options.parse(options.slurm or "", options.slurm_setup),
    ),
    "ray": Kind(
        lambda options: ray_cluster.make(options.ray or "", options.out),
        ("ray",),
        lambda options: ray_options.parse(options.ray or ""),
    ),
}


def check_launcher(options: LauncherOptions) -> None:
    """Checks the flags of the launcher, and not whether it can be used on this machine.

    Raises:
      UsageError: it is unknown, or a flag is invalid or of another launcher.
    """
    if options.launcher not in LAUNCHERS:
        raise UsageError(f"--launcher: {expects_one_of(options.launcher, LAUNCHERS)}")
    kind = LAUNCHERS[options.launcher]
    for name, other in LAUNCHERS.items():
        for flag in set(other.flags) - set(kind.flags):
            if getattr(options, flag) is not None:
                raise UsageError(f"--{flag}: has no effect with --launcher={options.launcher}; expects {name}")
    kind.check(options)


def make_launcher(options: LauncherOptions) -> Launcher:
    """The launcher named by `options.launcher`.

    Raises:
      UsageError: as `check_launcher`; or its package is missing, or it does not work here.
    """
    check_launcher(options)
    return LAUNCHERS[options.launcher].make(options)
