"""A grid of one's own: `--grid='penalty_coef=0.1,0.5;hidden=64,64|256,256'`, settings of runs with their values."""

from collections.abc import Iterable, Sequence
from itertools import product

from experiments.commandline.arguments import UsageError
from experiments.commandline.flag_table import FLAGS

# Flags of experiments.run that the grid sets, differently for each cell.
CELL_FLAGS = ("algo", "env", "out", "name", "resume", "overwrite")
NO_SETTINGS = (*CELL_FLAGS, "config", "help", "tuned")
OWN_GRID = "settings like 'penalty_coef=0.1,0.5;ensemble_size=2,5' with --algos and --tasks"
KNOWN = frozenset(flag.name for group in FLAGS.values() for flag in group)


def parse_variants(text: str) -> tuple[tuple[str, ...], ...]:
    """The variants of a grid like `penalty_coef=0.1,0.5;hidden=64,64|256,256`: all combinations of the values.

    Values are separated by commas; by `|` if there is one, for values with commas. Raises `UsageError`.
    """
    choices = []
    for part in filter(None, (part.strip() for part in text.split(";"))):
        setting, equals, values = part.partition("=")
        found = [value.strip() for value in values.split("|" if "|" in values else ",")]
        if not equals or not setting.isidentifier() or not all(found):
            raise UsageError(f"--grid={text}: expects {OWN_GRID}, not {part!r}")
        if setting in NO_SETTINGS:
            raise UsageError(f"--grid={text}: expects settings of a run, not {setting}")
        if len(set(found)) < len(found):
            raise UsageError(f"--grid={text}: expects each value of {setting} once")
        choices.append([f"--{setting}={value}" for value in found])
    names = [group[0].partition("=")[0] for group in choices]
    if len(set(names)) < len(names):
        raise UsageError(f"--grid={text}: expects each setting once")
    return tuple(product(*choices))


def check_not_set(variants: Iterable[Sequence[str]], run_flags: Iterable[str], grid: str) -> None:
    """Raises `UsageError` if a flag of every run sets what the variants set: it would win over their values.

    Args:
      grid: the value of --grid.
    """
    varied = {setting_of(word) for variant in variants for word in variant}
    for word in run_flags:
        if setting_of(word) in varied:
            raise UsageError(f"{word}: expects settings that --grid={grid} does not vary, not {setting_of(word)}")


def setting_of(word: str) -> str:
    """The setting that `--NAME=VALUE`, `--NAME` or `--noNAME` sets."""
    name = word.lstrip("-").partition("=")[0]
    return name if name in KNOWN else name.removeprefix("no")
