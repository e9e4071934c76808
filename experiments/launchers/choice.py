"""The launcher that the command line asks for."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from experiments.commandline.arguments import UsageError
from experiments.launchers import local, ray_cluster, slurm
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


LAUNCHERS = {
    "local": Kind(lambda options: local.make(options.workers or 1), ("workers",)),
    "slurm": Kind(
        lambda options: slurm.make(options.out, options.max_jobs, options.slurm, options.slurm_setup),
        ("max_jobs", "slurm", "slurm_setup", "detach"),
    ),
    "ray": Kind(lambda options: ray_cluster.make(options.ray or "", options.out), ("ray",)),
}


def make_launcher(options: LauncherOptions) -> Launcher:
    """The launcher named by `options.launcher`.

    Raises:
      UsageError: it is unknown, its package is missing, or a flag is invalid or of another launcher.
    """
    if options.launcher not in LAUNCHERS:
        raise UsageError(f"--launcher: {expects_one_of(options.launcher, LAUNCHERS)}")
    kind = LAUNCHERS[options.launcher]
    for name, other in LAUNCHERS.items():
        for flag in set(other.flags) - set(kind.flags):
            if getattr(options, flag) is not None:
                raise UsageError(f"--{flag}: has no effect with --launcher={options.launcher}; expects {name}")
    return kind.make(options)
