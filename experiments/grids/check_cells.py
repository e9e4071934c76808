"""Checks the cells of a grid before any of them starts: their settings, and that no run comes twice."""

import functools
from collections.abc import Sequence

from experiments.commandline import flags
from experiments.commandline.arguments import UsageError
from experiments.launchers.cell import Cell
from experiments.running.configurations import check_env, configs_of
from sqt_jax.envs import env_args
from sqt_jax.envs.factories import is_factory, make_from
from sqt_jax.types import Environment

OF_EVERY_CELL = ("--name=", "--out=")


def check_once(flag: str, words: Sequence[str], names: Sequence[str]) -> None:
    """Raises `UsageError` if two words of a list mean the same; `names`: what they mean."""
    for index, name in enumerate(names):
        if (first := names.index(name)) < index:
            raise UsageError(f"{flag}: expects each one once, not {words[first]} and {words[index]}")


def check_cells(cells: Sequence[Cell]) -> None:
    """Checks the cells as far as that does not depend on the machine: they may be trained on another one.

    Raises:
      UsageError: settings are invalid, or two cells are the same run or have one folder.
    """
    seen: dict[object, Cell] = {}
    for cell in cells:
        options = flags.parse(["run", *cell.command])
        assert options
        settings = repr(options._replace(name=None, wandb=None))
        for key in (cell.path, settings):
            if (first := seen.setdefault(key, cell)) is not cell:
                raise _twice(first, cell)
        env = own_environment(cell.task, options)
        check_env(options, env)
        configs_of(options, env)


def _twice(first: Cell, second: Cell) -> UsageError:
    if first.task != second.task:
        return UsageError(
            f"--tasks: expects environments of different names, not {first.task} and {second.task}, which are both "
            f"{first.path.parent.parent.name}"
        )
    one, other = (
        " ".join(word for word in cell.command if word not in rest.command and not word.startswith(OF_EVERY_CELL))
        for cell, rest in ((first, second), (second, first))
    )
    return UsageError(f"--grid: expects different runs, not {one} and {other}, which are the same one")


def own_environment(task: str, options: flags.Options) -> Environment | None:
    """The environment that `--tasks=MODULE:FUNCTION` makes, closed; None: the task has a name. Raises `UsageError`."""
    if not is_factory(task):
        return None
    try:
        return _closed(task, options.settings.get("env_args", ""), options.settings.get("max_episode_steps", 0))
    except ValueError as error:
        raise UsageError(f"--tasks: {task}: {error}") from None


@functools.lru_cache
def _closed(task: str, arguments: str, max_episode_steps: int) -> Environment:
    env = make_from(task, env_args.parse(arguments), max_episode_steps, 0)
    if env.host:
        env.host.close()
    return env
