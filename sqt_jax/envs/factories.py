"""Environments of your own by name: `my_tasks.pendulum:make` is what the function `make` of that module returns."""

import importlib
import re
import traceback
from pathlib import Path

from sqt_jax.types import Environment

NAME = re.compile(r"(?!brax:)([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*):([A-Za-z_]\w*)", re.ASCII)


def is_factory(name: str) -> bool:
    """Whether `name` has the form `module:function`; nothing is imported."""
    return NAME.fullmatch(name) is not None


def make_from(name: str) -> Environment:
    """The environment that a function of yours returns, called without arguments.

    This imports the module: call it with names only that the user has typed, never with those of a file.

    Raises:
      ValueError: there is no such module or function, it fails, or it returns something else. The text is one line
        with the place of the error.
    """
    match = NAME.fullmatch(name)
    if match is None:
        raise ValueError(f"expects MODULE:FUNCTION, not {name!r}")
    module, function = match.groups()
    try:
        env = getattr(importlib.import_module(module), function)()
    except Exception as error:  # of any type: it is the user's code
        last = traceback.extract_tb(error.__traceback__)[-1]
        text = " ".join(f"{type(error).__name__}: {error}".split())
        place = "" if last.filename == __file__ or "importlib" in last.filename else (
            f" ({Path(last.filename).name}, line {last.lineno})"
        )  # fmt: skip
        raise ValueError(f"{text[:300]}{place}") from error
    if not isinstance(env, Environment):
        kind = type(env).__name__
        raise ValueError(f"expects a function that returns an Environment (sqt_jax.make_environment), not a {kind}")
    return env
