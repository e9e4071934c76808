"""All comparisons of a task with Gymnasium, and the report on them."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from experiments.gymnasium_parity.distributions import (
    EpisodeComparison,
    StartComparison,
    compare_play,
    compare_starts,
    play_table,
    start_table,
)
from experiments.gymnasium_parity.gymnasium_reference import record_episode
from experiments.gymnasium_parity.trajectories import (
    EpisodeErrors,
    StepErrors,
    compare_episodes,
    compare_steps,
    episode_table,
    step_table,
)
from sqt_jax import envs

EPISODES = ((0, 1.0), (1, 0.3), (2, 0.05))  # seed and largest random action of the compared episodes

Cases = Mapping[str, tuple[str, dict[str, int]]]  # name -> physics and its options


class Counts(NamedTuple):
    """How much is compared."""

    states: int  # from which a control step is compared
    starts: int
    episodes: int  # of one policy


class TaskParity(NamedTuple):
    """The comparisons of one task."""

    steps: dict[str, StepErrors]  # by case
    starts: StartComparison
    episodes: EpisodeErrors | None  # None without the physics mujoco
    played: EpisodeComparison | None  # likewise


def physics_cases(physics: Sequence[str], solver: Mapping[str, dict[str, int]]) -> Cases:
    """Each physics with its default options, and MJX with other limits of its solver."""
    cases: dict[str, tuple[str, dict[str, int]]] = {name: (name, {}) for name in physics}
    if "mjx" in physics:
        cases |= {f"mjx {limits}": ("mjx", options) for limits, options in solver.items()}
    return cases


def compare_task(name: str, cases: Cases, counts: Counts) -> TaskParity:
    """Compares a task in each case; complete episodes only on the physics `mujoco`."""
    made = {case: envs.make(name, physics, **options) for case, (physics, options) in cases.items()}
    episodes = played = None
    if "mujoco" in made:
        theirs = [record_episode(name, seed, scale) for seed, scale in EPISODES]
        episodes = compare_episodes(made["mujoco"], theirs)
        played = compare_play(name, made["mujoco"], counts.episodes)
    return TaskParity(
        steps={case: compare_steps(name, env, counts.states) for case, env in made.items()},
        starts=compare_starts(name, counts.starts),
        episodes=episodes,
        played=played,
    )


def report(
    found: Mapping[str, TaskParity],
    speeds: Mapping[tuple[str, str], float],
    states: int,
    members: int,
    machine: Mapping[str, Any],
    command: str,
) -> str:
    """The report as Markdown.

    Args:
      found: by task.
      speeds: env steps per second of all members together, by task and case.
      states: as in `Counts`.
      members: number of environments in parallel in `speeds`.
      machine: its properties by name (`benchmarks.machine`), on which the speeds depend.
      command: the command line that made the report.
    """
    about = ", ".join(f"{key}: {value}" for key, value in machine.items())
    errors = {(name, case): row for name, task in found.items() for case, row in task.steps.items()}
    return "\n".join(
        [
            "# Parity with Gymnasium",
            "",
            f"By `{command}`. {about}.",
            "",
            "## Complete episodes on `mujoco`",
            "",
            "Random actions of three sizes until the episode ends; the largest |ours - theirs| / (1 + |theirs|).",
            "",
            *episode_table({name: task.episodes for name, task in found.items() if task.episodes}),
            "",
            "## One control step",
            "",
            f"From {states} states of Gymnasium's random rollouts, the solver not warm-started: median and 95 %",
            "quantile over the states of the largest error of an entry. qvel in rad/s or m/s; observation as above.",
            f"The speed is that of {members} environments in parallel with random actions, resets included.",
            "",
            *step_table({case: (row, speeds[case]) for case, row in errors.items()}),
            "",
            "## Starts",
            "",
            "Positions, velocities in units of the task's noise, ours against Gymnasium's; the largest of the entries:",
            "difference of the means, of the std (relative), of the ends of the range (only of positions where",
            "velocities are normal), and the p-value of a Kolmogorov-Smirnov test times the number of entries.",
            "",
            *start_table({name: task.starts for name, task in found.items()}),
            "",
            "## Episodes of one policy",
            "",
            "Random weights, from each side's own starts, ours on `mujoco`: mean length ± std, and p-values of",
            "Kolmogorov-Smirnov tests.",
            "",
            *play_table({name: task.played for name, task in found.items() if task.played}),
            "",
        ]
    )
