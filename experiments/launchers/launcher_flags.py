"""The flags of the commands that start runs through a launcher."""

from pathlib import Path
from typing import Any

from absl import flags

from experiments.commandline.path_flags import define_path
from experiments.launchers.choice import LAUNCHERS, LauncherOptions

flags.disclaim_key_flags()  # --help lists a flag with the module that defines it by this one


def define(workers: str) -> None:
    """Defines the flags of all launchers, and --retries.

    Args:
      workers: the help of --workers.
    """
    flags.DEFINE_string("launcher", "local", f"Where runs are started: {', '.join(LAUNCHERS)}.")
    flags.DEFINE_integer("workers", None, workers, 1)
    flags.DEFINE_integer("max_jobs", None, "With slurm: jobs of the array that run at the same time; default: all.", 1)
    flags.DEFINE_string("slurm", None, "With slurm: options of sbatch, as partition=gpu,gpus_per_node=1,time=04:00:00.")
    define_path("slurm_setup", None, "With slurm: a file of shell lines that each job runs first, as module load cuda.")
    flags.DEFINE_string("ray", None, "With ray: resources of a run, as num_cpus=2,num_gpus=1,resources.NAME=1.")
    flags.DEFINE_integer("retries", 2, "How often a run is started again that was killed or lost its machine.", 0)


def given(values: flags.FlagValues, out: Path) -> LauncherOptions:
    """The flags of launchers that were given."""
    options: dict[str, Any] = {name: values[name].value for name in LauncherOptions._fields if name in values}
    return LauncherOptions(**options | {"out": out})
