"""The flags of `python -m experiments.tabular`."""

import dataclasses
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from absl import flags as absl_flags

from experiments.commandline import arguments
from experiments.commandline.arguments import UsageError
from experiments.commandline.flags import ABSL_FLAGS
from experiments.commandline.path_flags import define_path
from experiments.theorem import mdps, q_learning, study
from sqt_jax.suggestions import did_you_mean, expects_one_of


def define_flags() -> absl_flags.FlagValues:
    """The flags with their defaults."""
    # Own flag values, because libraries define flags in the global ones.
    values = absl_flags.FlagValues()
    values.set_gnu_getopt(True)

    def define(kind: Callable, *arguments, **limits) -> None:
        kind(*arguments, flag_values=values, **limits)

    integer, number = absl_flags.DEFINE_integer, absl_flags.DEFINE_float
    define(absl_flags.DEFINE_list, "mdps", list(mdps.MDPS), f"MDPs: {', '.join(mdps.MDPS)}.")
    algos = list(q_learning.algorithms())
    define(absl_flags.DEFINE_list, "algos", algos, f"Algorithms: {', '.join(algos)}.")
    define(absl_flags.DEFINE_list, "coefs", ["0", "0.1", "0.25", "0.5", "1"], "SQT's penalty coefficients.")
    define(integer, "seeds", 20, "Number of seeds.", lower_bound=1, upper_bound=10_000)
    define(integer, "steps", 200_000, "Steps per member.", lower_bound=study.FIRST_MEASUREMENT, upper_bound=10**8)
    define(integer, "tables", 4, "Tables of MaxMin and SQT.", lower_bound=2, upper_bound=100)
    define(integer, "ddof", 1, "The std over tables divides by N - ddof.", lower_bound=0, upper_bound=1)
    define(absl_flags.DEFINE_string, "greedy", "min", f"Chooses SQT's a': {', '.join(q_learning.GREEDY)}.")
    define(number, "gamma", 0.8, "Discount factor, above 0 and below 1.", lower_bound=0.0)
    define(number, "lr_power", 0.7, "Step size 1 / n(s, a)^lr_power, above 0.5 and up to 1.", upper_bound=1.0)
    define(number, "epsilon", 1.0, "Share of random actions; 1: uniform.", lower_bound=0.0, upper_bound=1.0)
    define(number, "init_std", 0.0, "Std of the tables' initial values.", lower_bound=0.0)
    define(number, "weighted_c", 1.0, "Weighted Double Q-learning's c, above 0.", lower_bound=0.0)
    define(define_path, "out", "runs/tabular", "Folder of the results.")
    define(absl_flags.DEFINE_boolean, "overwrite", False, "Replace the results in the folder.")
    return values


def parse(argv: Sequence[str]) -> tuple[study.StudySettings, Path]:
    """The settings and the folder of the results, from the command line `argv`, program name first.

    Raises:
      UsageError: one line that names the first wrong flag and what it expects.
    """
    values = define_flags()
    for word in argv[1:]:
        name = word.lstrip("-").split("=")[0]
        if word.startswith("-") and name in ABSL_FLAGS:
            raise UsageError(f"--{name}: unknown flag; --help lists the flags")
    try:
        rest = values(list(argv), known_only=False)[1:]
    except absl_flags.UnrecognizedFlagError as error:
        hint = did_you_mean(f"--{error.flagname}", [f"--{name}" for name in values]) or "; --help lists the flags"
        raise UsageError(f"--{error.flagname}: unknown flag{hint}") from None
    except absl_flags.Error as error:
        found = re.search(r"-*(\w+)(?==|$)", str(error).removeprefix("flag ").splitlines()[0])
        if not found or found[1] not in values:
            raise UsageError(str(error).splitlines()[0]) from None
        wrong = values[found[1]]
        expects = wrong.parser.syntactic_help or ("true or false" if wrong.boolean else "a word")
        raise UsageError(f"--{found[1]}: expects {expects}") from None
    if rest:
        raise UsageError(f"{rest[0]}: unexpected argument; settings are given as --flag=value")
    flag: dict[str, Any] = {name: values[name].value for name in values}
    for name, known in (("mdps", mdps.MDPS), ("algos", q_learning.algorithms())):
        _check_list(name, flag[name])
        for word in flag[name]:
            if word not in known:
                raise UsageError(f"--{name}: {expects_one_of(word, known)}")
    if flag["greedy"] not in q_learning.GREEDY:
        raise UsageError(f"--greedy: {expects_one_of(flag['greedy'], q_learning.GREEDY)}")
    _check_list("coefs", flag["coefs"])
    coefs = [_coefficient(word) for word in flag["coefs"]]
    _check_list("coefs", coefs)
    flag["coefs"] = coefs
    for name in ("gamma", "lr_power", "epsilon", "init_std", "weighted_c"):
        if not math.isfinite(flag[name]):
            raise UsageError(f"--{name}: expects a number, not {flag[name]}")
    if not 0 < flag["gamma"] < 1:  # the ratios of eq. 16 are divided by it
        raise UsageError(f"--gamma: expects a number above 0 and below 1, not {flag['gamma']:g}")
    if flag["lr_power"] <= 0.5:
        raise UsageError(f"--lr_power: expects a number above 0.5 and up to 1, not {flag['lr_power']:g}")
    if flag["weighted_c"] == 0:
        raise UsageError("--weighted_c: expects a number above 0, not 0")
    out = flag.pop("out")
    _check_out(out, flag.pop("overwrite"))
    settings = {name: flag[name] for name in (field.name for field in dataclasses.fields(study.StudySettings))}
    for name in ("mdps", "algos", "coefs"):
        settings[name] = tuple(settings[name])
    return study.StudySettings(**settings), Path(out)


def _check_list(name: str, words: Sequence) -> None:
    if not words:
        raise UsageError(f"--{name}: expects at least one")
    for word in words:
        if words.count(word) > 1:
            raise UsageError(f"--{name}: expects each value once, got {word} {words.count(word)} times")


def _coefficient(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise UsageError(f"--coefs: expects numbers of at least 0 like 0,0.5, not {word!r}")
    return value


def _check_out(name: str, overwrite: bool) -> None:
    path = Path(name)
    if not name or "\0" in name:
        raise UsageError("--out: expects a folder")
    arguments.reject_folder("--out", path)
    try:
        if not overwrite and path.exists() and any(path.iterdir()):
            raise UsageError(f"--out={name}: exists; expects another folder, or also --overwrite")
    except OSError as error:
        raise UsageError(f"--out={name}: expects a folder that can be read: {error.strerror}") from None
    arguments.reject_existing(path, (study.TABLE, study.FIGURE), overwrite)
