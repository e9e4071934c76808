"""What a run says of its environments on the host: the exception that ended it, and steps that were not finite."""

from pathlib import Path

import numpy as np

from sqt_jax.one_line import one_line
from sqt_jax.types import Environment, HostError, TimeStep

FILE = "error.txt"  # in the run's folder: the traceback


def write_error(folder: Path, shown: Path, error: HostError) -> str:
    """Writes the traceback into the run's folder; returns where it is, in words.

    Args:
      shown: the folder as it is named in messages.
    """
    try:
        (folder / FILE).write_text(error.traceback, "utf-8", "backslashreplace")  # it may have bytes of file names
    except OSError as problem:
        return f"the traceback cannot be written: {one_line(problem)}"
    return f"traceback: {shown / FILE}"


def unstable_steps(env: Environment, timestep: TimeStep) -> str:
    """A line about the training's steps that were not finite; empty if there were none, or `env` is not on the host.

    Args:
      timestep: of all members, [S, E, ...].
    """
    if env.host is None:
        return ""
    counts = {name: int(np.sum(count)) for name, count in env.status(timestep).items()}
    steps, starts = counts["unstable_steps"], counts["unstable_starts"]
    if not steps + starts:
        return ""
    return (
        f"{steps:,} steps and {starts:,} starts of {env.name} had an observation, reward or action that is not finite, "
        "or beyond 1e10: such a step ends its episode with reward 0"
    )
