"""Environments of your own by name: `my_tasks.pendulum:make` is what the function `make` of that module returns."""

import importlib
import re
from collections.abc import Mapping
from functools import partial
from typing import Any

from sqt_jax.envs.gym_ids import from_gymnasium
from sqt_jax.one_line import with_place
from sqt_jax.types import Environment

NAME = re.compile(r"(?!(?:brax|gym|playground):)([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*):([A-Za-z_]\w*)", re.ASCII)


def is_factory(name: str) -> bool:
    """Whether `name` has the form `module:function`; nothing is imported."""
    return NAME.fullmatch(name) is not None


def make_from(
    name: str,
    arguments: Mapping[str, Any] | None = None,
    max_episode_steps: int = 0,
    processes: int = 0,
    in_program: bool = True,
) -> Environment:
    """The environment that a function of yours returns: an `Environment`, or one of Gymnasium.

    A function for Gymnasium is called several times and has to return a new environment each time.

    This imports the module: call it with names only that the user has typed, never with those of a file.

    Args:
      arguments: keyword arguments of the function.
      max_episode_steps: a time limit; only for Gymnasium's.
      processes: as in `host.host_environment`; only for Gymnasium's.
      in_program: as in `gym_ids.from_gymnasium`.

    Raises:
      ValueError: there is no such module or function, it fails, or it returns something else. The text is one line
        with the place of the error.
    """
    match = NAME.fullmatch(name)
    if match is None:
        raise ValueError(f"expects MODULE:FUNCTION, not {name!r}")
    module, function = match.groups()
    try:
        make = getattr(importlib.import_module(module), function)
        make = partial(make, **arguments) if arguments else make
        env = make()
        if _is_gymnasium(env):
            env.close()
    except (Exception, SystemExit) as error:  # of any type: it is the user's code
        raise ValueError(with_place(error, __file__)) from error
    if isinstance(env, Environment):
        if max_episode_steps or processes:
            raise ValueError("--max_episode_steps and --env_processes have no effect with an Environment in JAX")
        return env
    if _is_gymnasium(env):
        return from_gymnasium(name, make, max_episode_steps, processes, in_program)
    raise ValueError(
        "expects a function that returns an Environment (sqt_jax.make_environment) or a gymnasium.Env, not a "
        f"{type(env).__name__}"
    )


def _is_gymnasium(env: Any) -> bool:
    import gymnasium

    return isinstance(env, gymnasium.Env)
