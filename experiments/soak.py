"""Many steps of MuJoCo C under a scan: `python -m experiments.soak --steps=10000000`.

Random actions on all tasks in turn. Says after each part how many steps were made, whether every number was finite, and
how much memory the process holds: it must neither stop nor grow.
"""

import sys
import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import psutil
from absl import app, flags, logging

from experiments.running import runtime
from sqt_jax import envs, rollout
from sqt_jax.envs import TASKS

GROWTH_MIB = 64  # more than allocators' noise, far less than a leak of a few bytes a step
FLAGS = flags.FLAGS
flags.DEFINE_integer("steps", 10_000_000, "Environment steps in all.", lower_bound=1)
flags.DEFINE_integer("envs", 64, "Environments side by side.", lower_bound=1)
flags.DEFINE_integer("rounds", 5, "Times that each task has its turn.", lower_bound=2)


def make_part(task: str, num_envs: int):
    """`part(timesteps, key, steps)`: so many lockstep steps; also whether all numbers were finite."""
    env = envs.make(task, "mujoco")

    @jax.jit
    def part(timesteps, key, steps):
        def body(i, carry):
            timesteps, finite = carry

            def policy(_):
                return rollout.uniform_actions(jax.random.fold_in(key, i), num_envs, env.action_size)

            timesteps, transition = rollout.step(env, timesteps, policy)
            numbers = jax.tree.map(lambda x: jnp.all(jnp.isfinite(x)), transition)
            return timesteps, finite & jnp.all(jnp.stack(jax.tree.leaves(numbers)))

        return jax.lax.fori_loop(0, steps, body, (timesteps, jnp.array(True)))

    start = jax.jit(lambda key: rollout.reset(env, key, num_envs))(jax.random.key(0))
    return env, part, start


def main(argv: Sequence[str]) -> None:
    del argv
    logging.set_verbosity(logging.WARNING)
    runtime.prepare()
    process = psutil.Process()
    parts = {task: make_part(task, FLAGS.envs) for task in TASKS}
    state = {task: start for task, (_, _, start) in parts.items()}
    per_part = -(-FLAGS.steps // (FLAGS.rounds * len(parts) * FLAGS.envs))  # lockstep steps
    done, began = 0, time.monotonic()
    memory = []
    for turn in range(FLAGS.rounds):
        for number, (task, (env, part, _)) in enumerate(parts.items()):
            key = jax.random.fold_in(jax.random.key(turn), number)
            state[task], finite = part(state[task], key, per_part)
            unstable = int(jnp.sum(jax.vmap(env.status)(state[task])["unstable_steps"]))
            if not finite:
                sys.exit(f"{task}: a number that is not finite left the environment")
            done += per_part * FLAGS.envs
            print(
                f"{done:>12,} steps, {time.monotonic() - began:8.0f} s, {process.memory_info().rss / 2**20:7.0f} MiB, "
                f"{task}: {unstable} unstable steps",
                flush=True,
            )
        memory.append(process.memory_info().rss / 2**20)
    growth = memory[-1] - memory[0]
    if growth > GROWTH_MIB:
        sys.exit(f"memory grew by {growth:.0f} MiB after the first round")
    print(f"all numbers finite; memory grew by {growth:.0f} MiB after the first round")


if __name__ == "__main__":
    app.run(main)
