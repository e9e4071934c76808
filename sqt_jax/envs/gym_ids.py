"""Any environment that Gymnasium can make: `gym:Pendulum-v1`, `gym:my_package.my_module:MyEnv-v0`."""

import importlib
import re
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from importlib import metadata
from typing import Any

import jax

from sqt_jax.one_line import one_line, with_place
from sqt_jax.suggestions import did_you_mean
from sqt_jax.types import Environment

PREFIX = "gym:"
PHYSICS = ("gymnasium",)  # what computes their steps
NAME = re.compile(r"gym:(?:([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*):)?((?:[\w-]+/)?[\w.-]+)", re.ASCII)


def check_name(name: str) -> None:
    """Raises ValueError if `name` has another form than `gym:ID` or `gym:MODULE:ID`. Nothing is imported."""
    if NAME.fullmatch(name) is None:
        raise ValueError(f"expects gym:ID or gym:MODULE:ID, as in gym:Pendulum-v1, not {name!r}")


def module_of(name: str) -> str | None:
    """The module in the name, which is imported to make the environment; None: there is none."""
    match = NAME.fullmatch(name)
    return match[1] if match else None


def make_gym(
    name: str,
    arguments: Mapping[str, Any] | None = None,
    max_episode_steps: int = 0,
    processes: int = 0,
    in_program: bool = True,
) -> Environment:
    """The environment of a name with its prefix. This imports the module in the name.

    Args:
      arguments: keyword arguments of the environment.
      max_episode_steps: the time limit; 0: the environment's own.
      processes: as in `host.host_environment`.
      in_program: as in `from_gymnasium`.

    Raises:
      ValueError: there is no such environment, it cannot be made, or it cannot be trained on. The text is one line.
    """
    import gymnasium

    check_name(name)
    try:
        module = module_of(name)
        if module:
            importlib.import_module(module)
        spec = gymnasium.spec(name.removeprefix(PREFIX).rpartition(":")[2])
    except gymnasium.error.Error as error:
        known = [PREFIX + known for known in gymnasium.registry]
        raise ValueError(f"{error}{did_you_mean(name, known)}") from None
    except (Exception, SystemExit) as error:  # of any type: the module is the user's
        raise ValueError(with_place(error, __file__)) from error
    given = {"disable_env_checker": True, **(arguments or {})}
    if max_episode_steps:
        if "max_episode_steps" in given:
            raise ValueError("env_args: expects no max_episode_steps with --max_episode_steps, which sets it")
        given["max_episode_steps"] = max_episode_steps
    make = partial(gymnasium.make, spec, **given)
    return from_gymnasium(name, make, processes=processes, in_program=in_program)


def from_gymnasium(
    name: str, make: Callable[[], Any], max_episode_steps: int = 0, processes: int = 0, in_program: bool = True
) -> Environment:
    """The environment that plays in the Gymnasium environments that `make` makes.

    Args:
      make: makes one. It is called several times, and with `processes` pickled.
      max_episode_steps: a time limit in addition to the environment's own; 0: none.
      processes: as in `host.host_environment`.
      in_program: whether a compiled program steps it; not where its episodes are only played by hand (`Host.make`).

    Raises:
      ValueError: it fails, has no time limit, spaces that are not supported, or computes with JAX in this process.
    """
    from gymnasium.wrappers import TimeLimit

    from sqt_jax.envs.host import host_environment

    if max_episode_steps:
        make = partial(limited, make, max_episode_steps)
    try:
        env = make()
        limit = time_limit(env)
        in_jax, version = uses_jax(env), version_of(env)
        bounded = isinstance(env, TimeLimit) and env._max_episode_steps == limit
        env.close()
    except (Exception, SystemExit) as error:
        raise ValueError(with_place(error, __file__)) from error
    if not limit:
        raise ValueError("has no time limit, so that an evaluation might not end; add --max_episode_steps=N")
    if in_jax and in_program and not processes:
        raise ValueError("computes with JAX, which would wait for itself inside our program; add --env_processes=N")
    if not bounded:  # a wrapper around its time limit may hide the end of an episode
        make = partial(limited, make, limit)
    try:
        return host_environment(name, partial(quiet, make), limit, processes, version)
    except ValueError:
        raise
    except (Exception, SystemExit) as error:
        raise ValueError(one_line(error)) from error


def quiet(make: Callable[..., Any], **more: Any) -> Any:
    """`make(**more)` without its warnings: the first environment has shown them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return make(**more)


def limited(make: Callable[..., Any], max_episode_steps: int, **more: Any) -> Any:
    """`make(**more)` with a time limit."""
    from gymnasium.wrappers import TimeLimit

    return TimeLimit(make(**more), max_episode_steps)


def time_limit(env: Any) -> int | None:
    """The steps after which a Gymnasium environment truncates its episodes at the latest; None: unknown."""
    from gymnasium import Wrapper
    from gymnasium.wrappers import TimeLimit

    limits = [env.spec.max_episode_steps] if env.spec is not None else []
    while isinstance(env, Wrapper):
        if isinstance(env, TimeLimit):
            limits.append(env._max_episode_steps)
        env = env.env
    return min(filter(None, limits), default=None)


def version_of(env: Any) -> str:
    """The package that a Gymnasium environment comes from and its version; empty for a module of the user's own."""
    module = type(env.unwrapped).__module__.partition(".")[0]
    names = metadata.packages_distributions().get(module, [])
    return f"{names[0]} {metadata.version(names[0])}" if names else ""


def uses_jax(env: Any) -> bool:
    """Whether a Gymnasium environment computes with JAX: one of Gymnasium's own (`phys2d/...`), or JAX arrays in it."""
    kinds = {f"{kind.__module__}.{kind.__name__}" for kind in type(env.unwrapped).__mro__}
    if "gymnasium.envs.functional_jax_env.FunctionalJaxEnv" in kinds:
        return True
    return _holds_jax(vars(env.unwrapped))


def _holds_jax(tree: Any) -> bool:
    """Whether a JAX array is in `tree` or its branches, whose dictionaries may have keys that cannot be sorted."""
    todo, seen = [tree], {}
    while todo:
        node = todo.pop()
        if isinstance(node, jax.Array):
            return True
        if id(node) in seen:
            continue
        seen[id(node)] = node  # kept, so that no other object gets its number
        if isinstance(node, dict):
            todo += node.values()
        elif branches := jax.tree_util.default_registry.flatten_one_level(node):
            todo += branches[0]
    return False
