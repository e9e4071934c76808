"""How near our environments are to Gymnasium's: `python -m experiments.parity --out=parity.md`.

For each task and version: whole episodes on MuJoCo C against Gymnasium's own environment, single control steps of each
physics from the same states, starts and episodes in distribution, and the speed of five environments side by side.
The benchmark's flags --tasks, --physics, --solver, --seconds and --repeats are understood, and no others of its.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags, logging

from experiments import bench
from experiments.bench import check_flags, leaving, machine, physics_here, solver_limits
from experiments.benchmarks.measure import env_steps
from experiments.benchmarks.timing import measure_in_turns
from experiments.commandline import arguments
from experiments.gymnasium_parity.distributions import (
    Episodes,
    Starts,
    compare_play,
    compare_starts,
    play_table,
    start_table,
)
from experiments.gymnasium_parity.gymnasium_reference import Episode, episode, recorded
from experiments.running import runtime
from sqt_jax import envs
from sqt_jax.envs import TASKS
from sqt_jax.types import Environment

FLAGS = flags.FLAGS
flags.DEFINE_integer("states", 256, "States from which a step is compared.", lower_bound=16)
flags.DEFINE_integer("starts", 2_000, "Starts of episodes that are compared.", lower_bound=16)
flags.DEFINE_integer("episodes", 60, "Episodes of a policy of random weights that are compared.", lower_bound=2)
flags.DEFINE_string("out", "", "The report's file; it is printed in any case.")

TAKEN = ("tasks", "physics", "solver", "seconds", "repeats")  # of the benchmark's flags
MEMBERS = 5  # environments side by side in the timing

# Starts and sizes of the random actions of the compared episodes.
EPISODES = ((0, 1.0), (1, 0.3), (2, 0.05))


class WholeEpisodes(NamedTuple):
    """Largest |ours - theirs| / (1 + |theirs|) along the episodes."""

    steps: int
    obs: float
    reward: float
    terminations_agree: bool


class Steps(NamedTuple):
    """One control step; errors of a state are those of its worst entry."""

    qvel_median: float
    qvel_95: float
    obs_median: float  # |ours - theirs| / (1 + |theirs|)
    obs_95: float
    reward_median: float
    reward_95: float
    terminations_agree: float  # share of the states


def compare_episodes(env: Environment, episodes: Sequence[Episode]) -> WholeEpisodes:
    """Plays the episodes' actions from the episodes' starts."""
    longest = max(len(theirs.actions) for theirs in episodes)

    @jax.jit
    def play(start, actions):
        def step(timestep, action):
            timestep = env.step(timestep, action)
            return timestep, (timestep.final_obs, timestep.reward, timestep.terminated)

        return jax.lax.scan(step, start, actions)[1]

    steps, obs_error, reward_error, agree = 0, 0.0, 0.0, True
    for theirs in episodes:
        length = len(theirs.actions)
        actions = np.zeros((longest, env.action_size), np.float32)
        actions[:length] = theirs.actions
        assert env.set_physics is not None
        ours = play(env.set_physics(jnp.asarray(theirs.qpos), jnp.asarray(theirs.qvel)), actions)
        obs, reward, terminated = (np.asarray(leaf)[:length] for leaf in ours)
        steps += length
        obs_error = np.maximum(obs_error, _relative(obs, theirs.obs).max())  # NaN stays
        reward_error = np.maximum(reward_error, _relative(reward, theirs.reward).max())
        agree &= np.array_equal(terminated, theirs.terminated)
    return WholeEpisodes(steps, float(obs_error), float(reward_error), agree)


def compare_steps(name: str, env: Environment, count: int) -> Steps:
    """One step from `count` states of Gymnasium's own rollouts."""
    rows = recorded(name, count)
    assert env.set_physics is not None
    placed = jax.jit(jax.vmap(env.set_physics))(jnp.asarray(rows.qpos), jnp.asarray(rows.qvel))
    after = jax.jit(jax.vmap(env.step))(placed, rows.action)
    task = TASKS[name]
    first = rows.qpos.shape[1] - task.hidden
    velocities = slice(first, first + rows.qvel.shape[1])
    obs = np.asarray(after.final_obs, np.float64)
    expected = np.clip(rows.next_qvel, -task.max_speed, task.max_speed)
    qvel_error = np.abs(obs[:, velocities] - expected).max(axis=1)
    reward_error = np.abs(np.asarray(after.reward, np.float64) - rows.reward)
    obs_error = _relative(obs, rows.obs).max(axis=1)
    return Steps(
        qvel_median=float(np.median(qvel_error)),
        qvel_95=float(np.quantile(qvel_error, 0.95)),
        obs_median=float(np.median(obs_error)),
        obs_95=float(np.quantile(obs_error, 0.95)),
        reward_median=float(np.median(reward_error)),
        reward_95=float(np.quantile(reward_error, 0.95)),
        terminations_agree=float(np.mean(np.asarray(after.terminated) == rows.terminated)),
    )


def _relative(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    return np.abs(ours - theirs) / (1 + np.abs(theirs))


def episode_table(found: dict[str, WholeEpisodes]) -> list[str]:
    lines = ["| task | steps | observation | reward | terminations |", "|---|---|---|---|---|"]
    for name, row in found.items():
        agree = "equal" if row.terminations_agree else "DIFFER"
        lines.append(f"| {TASKS[name].gymnasium_id} | {row.steps:,} | {row.obs:.1e} | {row.reward:.1e} | {agree} |")
    return lines


def step_table(found: dict[tuple[str, str], tuple[Steps, float]]) -> list[str]:
    names = ("qvel", "qvel 95 %", "observation", "observation 95 %", "reward", "reward 95 %", "terminations equal")
    lines = [f"| task | physics | {' | '.join(names)} | env steps/s |", "|---" * (len(names) + 3) + "|"]
    for (name, physics), (row, speed) in found.items():
        numbers = " | ".join(f"{value:.1e}" for value in row[:6])
        share = f"{100 * row.terminations_agree:.1f} %"
        lines.append(f"| {TASKS[name].gymnasium_id} | {physics} | {numbers} | {share} | {speed:,.0f} |")
    return lines


def report(
    episodes: dict[str, WholeEpisodes],
    steps: dict[tuple[str, str], tuple[Steps, float]],
    starts: dict[str, Starts],
    played: dict[str, Episodes],
    command: str,
) -> str:
    about = ", ".join(f"{key}: {value}" for key, value in machine().items())
    return "\n".join(
        [
            "# Parity with Gymnasium",
            "",
            f"By `{command}`. {about}.",
            "",
            "## Whole episodes on `mujoco`",
            "",
            "Random actions of three sizes until the episode ends; the largest |ours - theirs| / (1 + |theirs|).",
            "",
            *episode_table(episodes),
            "",
            "## One control step",
            "",
            f"From {FLAGS.states} states of Gymnasium's random rollouts, the solver not warm-started: median and 95 %",
            "quantile over the states of the worst entry of each. qvel in rad/s or m/s; observation as above.",
            f"The speed is that of {MEMBERS} environments side by side with random actions, restarts included.",
            "",
            *step_table(steps),
            "",
            "## Starts",
            "",
            "Positions and velocities in units of the task's noise, ours against Gymnasium's; the worst entry of each:",
            "difference of the means, of the std (relative), of the ends of the range (of positions alone where",
            "velocities are normal), and the p-value of a Kolmogorov-Smirnov test times the number of entries.",
            "",
            *start_table(starts),
            "",
            "## Episodes of one policy",
            "",
            "Random weights, from each side's own starts, ours on `mujoco`: mean length ± std, and p-values of",
            "Kolmogorov-Smirnov tests.",
            "",
            *play_table(played),
            "",
        ]
    )


def cases(simulators: Sequence[str]) -> dict[str, tuple[str, dict[str, int]]]:
    """What a task is computed with: the row's name -> physics and its options."""
    found: dict[str, tuple[str, dict[str, int]]] = {name: (name, {}) for name in simulators}
    if "mjx" in simulators:
        found |= {f"mjx {limits}": ("mjx", options) for limits, options in solver_limits().items()}
    return found


def refuse_others() -> None:
    """Leaves with one line where a flag was given that the benchmark alone has a use for."""
    for flag in FLAGS.flags_by_module_dict()[bench.__name__]:
        if flag.present and flag.name not in TAKEN:
            sys.exit(f"--{flag.name}: has no effect here; expects of the benchmark's flags --{', --'.join(TAKEN)}")


def main(argv: Sequence[str]) -> None:
    del argv  # what absl leaves of it: no flags
    refuse_others()
    check_flags()
    if FLAGS.out:
        with leaving():
            arguments.reject_file("--out", Path(FLAGS.out), overwrite=True)
    logging.set_verbosity(logging.WARNING)
    runtime.prepare()
    rows = cases(physics_here())
    episodes: dict[str, WholeEpisodes] = {}
    steps: dict[tuple[str, str], tuple[Steps, float]] = {}
    starts: dict[str, Starts] = {}
    played: dict[str, Episodes] = {}
    for name in FLAGS.tasks:
        print(f"{name} ...", file=sys.stderr, flush=True)
        made = {row: envs.make(name, physics, **options) for row, (physics, options) in rows.items()}
        if "mujoco" in made:
            episodes[name] = compare_episodes(made["mujoco"], [episode(name, *case) for case in EPISODES])
            played[name] = compare_play(name, made["mujoco"], FLAGS.episodes)
        starts[name] = compare_starts(name, FLAGS.starts)
        runs = [env_steps(name, MEMBERS, physics, **options) for physics, options in rows.values()]
        rates = measure_in_turns(runs, FLAGS.seconds, FLAGS.repeats)
        for (row, env), (rate, _) in zip(made.items(), rates, strict=True):
            steps[name, row] = compare_steps(name, env, FLAGS.states), rate * MEMBERS
    text = report(episodes, steps, starts, played, " ".join(["python -m experiments.parity", *sys.argv[1:]]))
    print(text)
    if FLAGS.out:
        with leaving():
            arguments.write_file(Path(FLAGS.out), text.encode())


if __name__ == "__main__":
    FLAGS.set_default("tasks", list(TASKS))  # the flag is the benchmark's
    app.run(main)
