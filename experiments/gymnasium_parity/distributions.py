"""Distributions of ours against Gymnasium's: starts, and lengths and returns of episodes of one policy."""

import warnings
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from experiments.gymnasium_parity.gymnasium_reference import gymnasium_environment
from sqt_jax.envs import TASKS, gym_tasks
from sqt_jax.evaluate import evaluate_policy
from sqt_jax.types import Environment


class StartComparison(NamedTuple):
    """Differences of starts (positions and velocities), in units of the task's noise; the largest over all entries."""

    number: int
    mean: float  # |ours - theirs|
    std: float  # |ours / theirs - 1|
    range: float  # |ours - theirs|, the larger of both ends
    p_value: float  # of the Kolmogorov-Smirnov test, times the number of entries


class EpisodeComparison(NamedTuple):
    """Complete episodes of one policy with random weights, from each side's own starts."""

    number: int
    our_lengths: np.ndarray  # [number]
    their_lengths: np.ndarray  # [number]
    length_p_value: float  # of the Kolmogorov-Smirnov test
    return_p_value: float


def compare_starts(name: str, count: int) -> StartComparison:
    """Draws `count` starts of a task on each side; a `p_value` near 0 means that they differ."""
    task, env = TASKS[name], gymnasium_environment(name)
    keys = jax.random.split(jax.random.key(0), count)
    draws = jax.vmap(lambda key: gym_tasks.draw_start(task, env.model.qpos0, env.model.nv, key))(keys)
    rest = np.concatenate([env.model.qpos0, np.zeros(env.model.nv)])
    ours = (np.concatenate(draws, axis=1) - rest) / task.noise
    theirs = []
    env.reset(seed=0)
    for _ in range(count):
        env.reset_model()
        theirs.append(np.concatenate([env.data.qpos, env.data.qvel]))
    theirs = (np.array(theirs) - rest) / task.noise
    p_values = [stats.ks_2samp(a, b).pvalue for a, b in zip(ours.T, theirs.T, strict=True)]
    ends = np.abs(np.stack([ours.min(0) - theirs.min(0), ours.max(0) - theirs.max(0)]))
    # Normal velocities have no range.
    bounded = ends[:, : env.model.nq] if task.normal_velocity else ends
    return StartComparison(
        number=count,
        mean=float(np.abs(ours.mean(0) - theirs.mean(0)).max()),
        std=float(np.abs(ours.std(0) / theirs.std(0) - 1).max()),
        range=float(bounded.max()),
        p_value=min(1.0, len(p_values) * min(p_values)),
    )


def compare_play(name: str, env: Environment, count: int) -> EpisodeComparison:
    """Runs `count` episodes of a task on each side, ours in `env`; p-values near 0 mean that they differ."""
    size, actions = env.observation_size, env.action_size
    weights = np.random.default_rng(0).normal(size=(size, actions)).astype(np.float32) / np.sqrt(size)
    our_returns, our_lengths = evaluate_policy(lambda obs: jnp.tanh(obs @ weights), env, count)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium recommends v5 instead of v4
        theirs = gymnasium.make(TASKS[name].gymnasium_id)
    their_returns, their_lengths = evaluate_policy(lambda obs: np.tanh(obs @ weights), theirs, count)
    return EpisodeComparison(
        number=count,
        our_lengths=np.asarray(our_lengths),
        their_lengths=np.asarray(their_lengths),
        length_p_value=float(stats.ks_2samp(our_lengths, their_lengths).pvalue),
        return_p_value=float(stats.ks_2samp(our_returns, their_returns).pvalue),
    )


def start_table(found: dict[str, StartComparison]) -> list[str]:
    """A Markdown table, as lines: a row per task."""
    lines = ["| task | starts | mean | std | range | p |", "|---|---|---|---|---|---|"]
    for name, row in found.items():
        numbers = f"{row.mean:.3f} | {row.std:.3f} | {row.range:.3f} | {row.p_value:.2f}"
        lines.append(f"| {TASKS[name].gymnasium_id} | {row.number:,} | {numbers} |")
    return lines


def play_table(found: dict[str, EpisodeComparison]) -> list[str]:
    """A Markdown table, as lines: a row per task."""
    lines = ["| task | episodes | length here | in Gymnasium | p, lengths | p, returns |", "|---|---|---|---|---|---|"]
    for name, row in found.items():
        ours, theirs = (f"{x.mean():,.1f} ± {x.std(ddof=1):,.1f}" for x in (row.our_lengths, row.their_lengths))
        p_values = f"{row.length_p_value:.2f} | {row.return_p_value:.2f}"
        lines.append(f"| {TASKS[name].gymnasium_id} | {row.number} | {ours} | {theirs} | {p_values} |")
    return lines
