"""Whether the members of a run fit into memory, before anything is compiled."""

import jax
import psutil

from experiments.commandline.arguments import UsageError
from sqt_jax.config import Config
from sqt_jax.experiment import memory_estimate
from sqt_jax.job_limits import memory_limits
from sqt_jax.members import Layout
from sqt_jax.types import Environment


class TooLittle(UsageError):
    """The members need more memory than is free. `problem` is the text without a flag and what it expects."""

    def __init__(self, problem: str, capacity: int):
        super().__init__(f"--replay_capacity={capacity}: {problem}; expects a smaller number, or fewer --seeds")
        self.problem = problem


def check(config: Config, layout: Layout, env: Environment, runs: int = 1) -> None:
    """Raises `TooLittle` if the members of so many equal runs side by side need more memory than is free."""
    needed = runs * memory_estimate(config, layout.padded_size, env)
    free, where = free_memory(len(layout.devices))
    if needed > free:
        who = f"{layout.members} members" if runs == 1 else f"{runs} runs of {layout.members} members"
        raise TooLittle(
            f"{who} need about {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free {where}",
            config.train.replay_capacity,
        )


def free_memory(devices: int) -> tuple[int, str]:
    """Bytes available to a run, and what limits them: the accelerators, the machine or a limit of the job."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return devices * (stats["bytes_limit"] - stats.get("bytes_in_use", 0)), "on the devices"
    found = [(limit.left, f"under {limit.name}") for limit in memory_limits()]
    return min([(psutil.virtual_memory().available, "here"), *found])
