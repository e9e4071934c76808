"""Our environments against Gymnasium's from the same states and actions: complete episodes, control steps."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.gymnasium_parity.gymnasium_reference import RecordedEpisode, recorded
from sqt_jax.envs import TASKS
from sqt_jax.types import Environment


class EpisodeErrors(NamedTuple):
    """Complete episodes; the largest |ours - theirs| / (1 + |theirs|) of their steps."""

    steps: int  # of all episodes
    obs: float
    reward: float
    terminations_agree: bool


class StepErrors(NamedTuple):
    """One control step: median and 95 % quantile over states of the largest error of an entry."""

    qvel_median: float  # |ours - theirs|, rad/s or m/s
    qvel_95: float
    obs_median: float  # |ours - theirs| / (1 + |theirs|)
    obs_95: float
    reward_median: float  # |ours - theirs|
    reward_95: float
    terminations_agree: float  # share of the states


def compare_episodes(env: Environment, episodes: Sequence[RecordedEpisode]) -> EpisodeErrors:
    """Repeats the episodes' actions from their initial states.

    Args:
      env: one with `set_physics`, on MuJoCo C.
      episodes: Gymnasium's.
    """
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
        obs_error = np.maximum(obs_error, _relative(obs, theirs.obs).max())  # keeps NaN
        reward_error = np.maximum(reward_error, _relative(reward, theirs.reward).max())
        agree &= np.array_equal(terminated, theirs.terminated)
    return EpisodeErrors(steps=steps, obs=float(obs_error), reward=float(reward_error), terminations_agree=agree)


def compare_steps(name: str, env: Environment, count: int) -> StepErrors:
    """One step of a task from `count` states of Gymnasium's own random rollouts.

    Args:
      env: one with `set_physics`, on any physics.
    """
    rows = recorded(name, count)
    assert env.set_physics is not None
    placed = jax.jit(jax.vmap(env.set_physics))(jnp.asarray(rows.qpos), jnp.asarray(rows.qvel))
    after = jax.jit(jax.vmap(env.step))(placed, rows.action)
    task = TASKS[name]
    first = rows.qpos.shape[1] - task.unobserved
    velocities = slice(first, first + rows.qvel.shape[1])
    obs = np.asarray(after.final_obs, np.float64)
    expected = np.clip(rows.next_qvel, -task.max_speed, task.max_speed)
    qvel_error = np.abs(obs[:, velocities] - expected).max(axis=1)
    reward_error = np.abs(np.asarray(after.reward, np.float64) - rows.reward)
    obs_error = _relative(obs, rows.obs).max(axis=1)
    return StepErrors(
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


def episode_table(found: dict[str, EpisodeErrors]) -> list[str]:
    """A Markdown table, as lines: a row per task."""
    lines = ["| task | steps | observation | reward | terminations |", "|---|---|---|---|---|"]
    for name, row in found.items():
        agree = "equal" if row.terminations_agree else "DIFFER"
        lines.append(f"| {TASKS[name].gymnasium_id} | {row.steps:,} | {row.obs:.1e} | {row.reward:.1e} | {agree} |")
    return lines


def step_table(found: dict[tuple[str, str], tuple[StepErrors, float]]) -> list[str]:
    """A Markdown table, as lines: a row per task and physics, with errors and env steps per second."""
    names = ("qvel", "qvel 95 %", "observation", "observation 95 %", "reward", "reward 95 %", "terminations equal")
    lines = [f"| task | physics | {' | '.join(names)} | env steps/s |", "|---" * (len(names) + 3) + "|"]
    for (name, physics), (row, speed) in found.items():
        numbers = " | ".join(f"{value:.1e}" for value in row[:6])
        share = f"{100 * row.terminations_agree:.1f} %"
        lines.append(f"| {TASKS[name].gymnasium_id} | {physics} | {numbers} | {share} | {speed:,.0f} |")
    return lines
