"""Table 1: the sizes of the paper's tasks and of the runs' tasks."""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.evidence import published
from experiments.evidence.cells import NOTHING, Cell, Line, ResultTable
from experiments.evidence.groups import Group
from experiments.evidence.pooling import Collected
from experiments.evidence.published import PAPERS_TASKS
from experiments.running import files
from sqt_jax import envs, policy_folders

MAX_POLICY_BYTES = 1_000_000
COLUMNS = ("observation", "action", "episode_steps")


def read_sizes(collected: Collected) -> list[dict[str, Any]]:
    """A record per task whose sizes are known; `episode_steps` is None where only the sizes are.

    They are read from the environment, or, where it cannot be made by its name, from a run's config.json or policy.
    """
    found = [dict(_sizes_by_name(name)) for name in PAPERS_TASKS]
    for task in collected.tasks:
        if task in PAPERS_TASKS:
            continue
        groups = [group for group in collected.groups if group.env == task]
        record = None if groups[0].own_env else _known(task)
        record = record or _sizes_by_runs(task, groups)
        found += [dict(record)] if record else []
    return found


def table_1(sizes: Sequence[Mapping[str, Any]], reference: bool) -> ResultTable:
    """Table 1 of the records of `read_sizes`; `reference`: with the paper's sizes."""
    header = ["--env", "task", "observation", "action", "steps of an episode"]
    of_paper = published.paper()["table1_obs_action"] if reference else {}
    lines, records = [], []
    for row in sizes:
        numbers = [NOTHING if row[name] is None else f"{row[name]:,}" for name in COLUMNS]
        cells = [row["env"], row["task"], *numbers]
        record = dict(row)
        if reference:
            observation, action = of_paper.get(row["env"], ("", ""))
            cells.append(f"{observation} / {action}" if row["env"] in of_paper else NOTHING)
            record |= {"paper_observation": observation, "paper_action": action}
        lines.append(Line([Cell((cell,)) for cell in cells]))
        records.append(record)
    header += [f"{published.PAPER}: observation / action"] if reference else []
    caption = "Read from the environments."
    if any(row["episode_steps"] is None for row in sizes):
        caption += " Without the steps of an episode: read from the runs."
    return ResultTable(
        name="table1",
        title="Table 1: sizes of the tasks",
        header=header,
        sections=[lines],
        caption=caption,
        notes=[],
        records=records,
    )


def _known(name: str) -> Mapping[str, Any] | None:
    """The sizes of an environment that can be made by its name here. Nothing is imported that a file names."""
    try:
        return _sizes_by_name(name) if envs.is_built_in(name) else None
    except ValueError:
        return None


@functools.cache
def _sizes_by_name(name: str) -> Mapping[str, Any]:
    env = envs.make(name, "mujoco" if "mujoco" in envs.physics_of(name) else None)
    task = envs.TASKS[name].gymnasium_id if name in envs.TASKS else f"Brax {name.partition(':')[2]}"
    sizes = {"observation": env.observation_size, "action": env.action_size, "episode_steps": env.episode_length}
    return {"env": name, "task": task} | sizes


def _id(name: str) -> str | None:
    """`Pendulum-v1` of `gym:Pendulum-v1`; None for a name without such a prefix."""
    try:
        return name.partition(":")[2] if envs.takes_arguments(envs.resolve(name)) else None
    except ValueError:
        return None


def _sizes_by_runs(task: str, groups: Sequence[Group]) -> Mapping[str, Any] | None:
    """The sizes in the first config.json, or config.json of a policy, of the task's runs that has them; else None."""
    kind = "own environment" if groups[0].own_env else _id(task) or "unknown here"
    for run, own_sizes in dict.fromkeys((member.run, member.own_sizes) for g in groups for member in g.members):
        sizes = own_sizes or _sizes_of_policy(run)
        if sizes:
            observation, action = sizes
            return {"env": task, "task": kind, "observation": observation, "action": action, "episode_steps": None}
    return None


def _sizes_of_policy(run: Path) -> tuple[int, int] | None:
    def read(folder: Path) -> Any:
        return files.read_json(folder / "config.json", MAX_POLICY_BYTES)

    try:
        content, _ = policy_folders.read_first(run, False, read)
        observation, action = content["observation_size"], content["action_size"]
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return (observation, action) if type(observation) is type(action) is int else None
