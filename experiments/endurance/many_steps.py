"""Many random steps of MuJoCo C under a scan: all numbers must stay finite, and the memory must not grow."""

import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import psutil

from sqt_jax import envs, rollout

GROWTH_MIB = 64  # more than the allocators' noise, far less than a leak of a few bytes per step


class SoakFailure(Exception):
    """A number was not finite, or the memory grew. The text says which."""


def make_steps(task: str, num_envs: int):
    """An environment and its jitted steps.

    Returns:
      The environment; `advance(timesteps, key, steps) -> (timesteps, finite)` for `steps` lockstep steps with random
      actions, where `finite` [] says whether all numbers were finite; and the first timesteps.
    """
    env = envs.make(task, "mujoco")

    @jax.jit
    def advance(timesteps, key, steps):
        def body(i, carry):
            timesteps, finite = carry

            def policy(_):
                return rollout.uniform_actions(jax.random.fold_in(key, i), num_envs, env.action_size)

            timesteps, transition = rollout.step(env, timesteps, policy)
            numbers = jax.tree.map(lambda x: jnp.all(jnp.isfinite(x)), transition)
            return timesteps, finite & jnp.all(jnp.stack(jax.tree.leaves(numbers)))

        return jax.lax.fori_loop(0, steps, body, (timesteps, jnp.array(True)))

    timesteps = jax.jit(lambda key: rollout.reset(env, key, num_envs))(jax.random.key(0))
    return env, advance, timesteps


def run_soak(tasks: Sequence[str], steps: int, num_envs: int, rounds: int, say: Callable[[str], None]) -> None:
    """Steps all tasks, one after another, `rounds` times.

    Args:
      steps: environment steps in total.
      num_envs: environments in lockstep.
      rounds: at least 2; the memory after the last is compared with that after the first.
      say: called with each line to print.

    Raises:
      SoakFailure: a number was not finite, or the memory grew by more than `GROWTH_MIB`.
    """
    process = psutil.Process()
    parts = {task: make_steps(task, num_envs) for task in tasks}
    timesteps = {task: first for task, (_, _, first) in parts.items()}
    per_part = -(-steps // (rounds * len(parts) * num_envs))  # lockstep steps
    done, began = 0, time.monotonic()
    memory = []  # MiB after each round
    for round_number in range(rounds):
        for number, (task, (env, advance, _)) in enumerate(parts.items()):
            key = jax.random.fold_in(jax.random.key(round_number), number)
            timesteps[task], finite = advance(timesteps[task], key, per_part)
            unstable = int(jnp.sum(jax.vmap(env.status)(timesteps[task])["unstable_steps"]))
            if not finite:
                raise SoakFailure(f"{task}: the environment returned a number that is not finite")
            done += per_part * num_envs
            say(
                f"{done:>12,} steps, {time.monotonic() - began:8.0f} s, {_memory(process):7.0f} MiB, "
                f"{task}: {unstable} unstable steps"
            )
        memory.append(_memory(process))
    growth = memory[-1] - memory[0]
    if growth > GROWTH_MIB:
        raise SoakFailure(f"memory grew by {growth:.0f} MiB after the first round")
    say(f"all numbers finite; memory grew by {growth:.0f} MiB after the first round")


def _memory(process: psutil.Process) -> float:
    return process.memory_info().rss / 2**20
