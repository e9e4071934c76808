"""Environment variables that a library would read when imported, and other inherited settings of the process."""

import logging
import os
import re
import resource
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

NO_HOME = os.devnull  # no folder can be made in it, by root neither
MANY_FILES = 65_536
# A word of Python's own options that ends with -m, or with -mMODULE.
MODULE_OPTION = re.compile(r"-[bBdEiIOPqsSuvx]*m(.*)")
# Variables of JAX with any text as their value: they need no check.
TEXTS = {"JAX_COMPILATION_CACHE_DIR", "JAX_PLATFORMS"}


def module_of(argv: Sequence[str]) -> str:
    """The module that `python -m MODULE` runs, from Python's own command line (`sys.orig_argv`); empty if none."""
    for word, following in zip(argv, [*argv[1:], ""], strict=True):
        if match := MODULE_OPTION.fullmatch(word):
            return match[1] or following
    return ""


def prepare(command: str) -> None:
    """Makes the process independent of the user's settings for libraries. Call before these are imported.

    Args:
      command: the module that is run, `experiments.run`.

    Raises:
      SystemExit: a variable has a value with which JAX cannot be imported; the exit code is 2.
    """
    # Notebooks set a backend that needs their own packages; a user's rc file may need LaTeX.
    os.environ |= {"MPLBACKEND": "agg", "MATPLOTLIBRC": os.devnull}
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it warns where it cannot keep its font cache
    if command != "experiments.play":  # only films need OpenGL; MuJoCo rejects an unknown value when imported
        os.environ["MUJOCO_GL"] = "disable"
    if any(option.startswith("error") for option in sys.warnoptions):
        os.environ.pop("PYTHONWARNINGS", None)
        warnings.filterwarnings("default")  # a library's warning is no error
    if not has_home():
        os.environ["HOME"] = NO_HOME  # else libraries fail when they look for it
    _allow_many_files()
    if any(name.startswith("JAX_") for name in os.environ.keys() - TEXTS):
        _check_import_of_jax()


def has_home() -> bool:
    """Whether the user has a home folder."""
    try:
        return Path.home().is_dir()
    except (RuntimeError, OSError):  # HOME is not set, and the system does not know the user
        return False


def _allow_many_files() -> None:
    """Raises the limit of open files: a run has an event file per member."""
    soft, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MANY_FILES if most == resource.RLIM_INFINITY else min(MANY_FILES, most)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(ValueError, OSError):  # macOS allows less than it says
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, most))


def _check_import_of_jax() -> None:
    try:
        import jax  # noqa: F401  it reads its variables when imported
    except ValueError as error:
        print(f"{' '.join(str(error).split())}: a variable of JAX; expects a valid value, or none", file=sys.stderr)
        raise SystemExit(2) from None
