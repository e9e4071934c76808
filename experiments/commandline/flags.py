"""A command line's text as `Options`.

A flag that is not given is absent from the result: defaults belong to the algorithms. What is checked here needs
nothing but the text of the command line, so that a typing error is answered before any heavy import; the limits of
the settings are `sqt_jax.algorithms.make_config`'s.
"""

import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from absl import flags as absl_flags

from experiments.commandline import config_file
from experiments.commandline.arguments import UsageError
from experiments.commandline.flag_table import DEFAULT_SEEDS, EXAMPLE, FLAGS, Flag
from experiments.commandline.presets import PRESETS
from sqt_jax.config import ConfigError, check_value
from sqt_jax.names import nearest
from sqt_jax.types import Scalars

MAX_SEED = 2**32 - 1
MAX_MEMBERS = 10_000
# What absl understands beside the flags that are defined: another file of flags, and flags that may be unknown.
ABSL_FLAGS = ("flagfile", "undefok")
# The run's own flags that a resumed run expects over; the smallest value of each.
OUTPUT = {"checkpoint_every": 0, "keep_checkpoints": 1, "devices": 1, "tensorboard": False}
LATEST = "\n"  # no folder's name on a command line


class Options(NamedTuple):
    """A parsed command line. Only what was given is in `settings` and `sweep`; None is what was not."""

    algo: str | None  # not required with the folder of a run to resume; neither is env
    env: str | None
    seeds: tuple[int, ...] | None
    settings: dict[str, Any]  # one value for all members
    sweep: dict[str, tuple[float, ...]]  # scalars with several values, in the order of `Scalars`
    preset: str
    out: str
    name: str | None
    resume: str | None  # the folder of a run; LATEST: the one that these settings belong to
    overwrite: bool
    checkpoint_every: int | None
    keep_checkpoints: int | None
    devices: int | None
    tensorboard: bool | None
    quiet: bool


class _Parser(absl_flags.ArgumentParser):
    def __init__(self, flag: Flag):
        self.flag = flag
        self.syntactic_help = flag.expects

    def parse(self, argument: str) -> Any:
        assert self.flag.parse is not None
        try:
            return self.flag.parse(argument)
        except (ValueError, OverflowError):
            raise ValueError(f"expects {self.flag.expects}") from None


def _values(argv: Sequence[str]) -> dict[str, Any]:
    """The flags that were given, parsed by type."""
    # Own flag values: the libraries define flags of theirs in the global ones.
    values = absl_flags.FlagValues()
    values.set_gnu_getopt(True)
    known = [flag for group in FLAGS.values() for flag in group]
    for word in argv[1:]:
        name = word.lstrip("-").split("=")[0]
        if word.startswith("-") and name in ABSL_FLAGS:
            raise UsageError(f"--{name}: unknown flag; --help lists the flags")
    for flag in known:
        if flag.parse is None:
            absl_flags.DEFINE_boolean(flag.name, None, flag.help, flag_values=values)
        else:
            absl_flags.DEFINE(_Parser(flag), flag.name, None, flag.help, flag_values=values)
    try:
        rest = values(_with_resume_valued(argv), known_only=False)[1:]
    except absl_flags.UnrecognizedFlagError as error:
        hint = nearest(f"--{error.flagname}", [f"--{flag.name}" for flag in known]) or "; --help lists the flags"
        raise UsageError(f"--{error.flagname}: unknown flag{hint}") from None
    except (absl_flags.Error, ValueError) as error:
        text = str(error).removeprefix("flag ").removeprefix("ERROR:: ")
        text = re.sub(r"\('Non-boolean argument to boolean flag', .*\)", "expects true or false", text)
        missing = re.fullmatch(r"Missing value for flag -*(\w+)", text)
        if missing:
            expects = next(flag.expects for flag in known if flag.name == missing[1])
            text = f"--{missing[1]}: expects {expects}"
        raise UsageError(text) from None
    if rest:
        raise UsageError(f"{rest[0]}: unexpected argument; settings are given as --flag=value")
    return {flag.name: values[flag.name].value for flag in known if values[flag.name].present}


def _with_resume_valued(argv: Sequence[str]) -> list[str]:
    """`--resume` alone, at the end or before another flag, as `--resume=LATEST`."""
    following = [*argv[1:], "-"]
    return [
        f"{word}={LATEST}" if word.lstrip("-") == "resume" and word != "resume" and after.startswith("-") else word
        for word, after in zip(argv, following, strict=True)
    ]


def _file_values(name: str) -> dict[str, Any]:
    """The flags of a YAML file, parsed as those of a command line."""
    try:
        arguments = config_file.arguments(Path(name))
    except config_file.InvalidConfigFile as error:
        raise UsageError(f"--config={name}: {error}") from None
    try:
        return _values(["", *arguments])
    except UsageError as error:
        raise UsageError(f"{error} (in {name})") from None


def parse(argv: Sequence[str], needs_env: bool = True) -> Options | None:
    """A command line (program name first) as `Options`; None where it asks for help.

    Raises `UsageError` for everything the text alone gives away.
    """
    given = argv[1 : argv.index("--")] if "--" in argv else argv[1:]
    if any(word in ("--help", "-help", "--h", "-h", "-?") for word in given):
        return None
    values = _values(argv)
    if "config" in values:
        values = _file_values(values.pop("config")) | values
    own = {name: values.pop(name, None) for name in ("algo", "env", "seeds", "preset", "out", "name")}
    output = {name: values.pop(name, None) for name in OUTPUT}
    resume, overwrite = values.pop("resume", None), values.pop("overwrite", False)
    if resume == "":
        raise UsageError("--resume=: expects the folder of a run, or nothing at all: --resume")
    folder_given = resume not in (None, LATEST)
    for required in ("algo", "env") if needs_env else ("algo",):
        if not own[required] and resume in (None, LATEST):
            raise UsageError(f"--{required}: is required, as in {EXAMPLE}")
    if resume is not None and overwrite:
        raise UsageError(
            "--overwrite: expects no --resume beside it: the one replaces a run, the other goes on with it"
        )
    for name in ("out", "name", "preset"):
        if folder_given and own[name] is not None:
            raise UsageError(f"--{name}: has no effect with --resume={resume}")
    for name, lowest in OUTPUT.items():
        if output[name] is not None and output[name] < lowest:
            raise UsageError(f"--{name}: expects a whole number of at least {lowest}, not {output[name]}")

    preset = own["preset"] or "paper"
    if preset not in PRESETS:
        raise UsageError(f"--preset={preset}: expects one of {', '.join(PRESETS)}")

    name = own["name"]
    if name is not None and (
        name in ("", ".", "..")
        or name[0] == "-"
        or set(name) & set("/\\")
        or not name.isprintable()
        or len(name.encode()) > 200
    ):
        raise UsageError(
            f"--name={name[:40]}: expects up to 200 bytes, no slashes or control characters: it names a folder"
        )
    for flag, folder in (("out", own["out"]), ("resume", resume if folder_given else None)):
        if folder is not None and not (folder and _is_path(folder)):
            raise UsageError(f"--{flag}={folder[:40]}: expects a folder")

    settings: dict[str, Any] = {}
    sweep: dict[str, tuple[float, ...]] = {}
    quiet = values.pop("quiet", False)
    if values.get("temperature") == "auto":
        del values["temperature"]
        settings["learn_temperature"] = True
    for setting, value in values.items():
        choices = value if setting in Scalars._fields else (value,)
        try:
            for choice in choices:
                check_value(setting, choice)
        except ConfigError as error:
            raise UsageError(str(error)) from None
        _refuse_duplicates(setting, choices)
        if len(choices) > 1:
            sweep[setting] = choices
        else:
            settings[setting] = choices[0]
    sweep = {scalar: sweep[scalar] for scalar in Scalars._fields if scalar in sweep}
    count = math.prod(map(len, sweep.values())) * len(own["seeds"] or DEFAULT_SEEDS)
    if count > MAX_MEMBERS:
        raise UsageError(f"--seeds: expects at most {MAX_MEMBERS} members, seeds times swept values, not {count}")
    return Options(
        algo=own["algo"],
        env=own["env"],
        seeds=_check_seeds(own["seeds"]) if own["seeds"] is not None else None if folder_given else DEFAULT_SEEDS,
        settings=settings,
        sweep=sweep,
        preset=preset,
        out=own["out"] or "runs",
        name=name,
        resume=resume,
        overwrite=overwrite,
        quiet=quiet,
        **output,
    )


def _check_seeds(seeds: tuple[int, ...]) -> tuple[int, ...]:
    for seed in seeds:
        if not 0 <= seed <= MAX_SEED:
            raise UsageError(f"--seeds={seed}: expects whole numbers from 0 to {MAX_SEED}")
    _refuse_duplicates("seeds", seeds)
    return seeds


def _is_path(text: str) -> bool:
    """Whether the system can have a file of that name; a YAML file can ask for others."""
    try:
        return b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        return False


def _refuse_duplicates(name: str, values: Sequence[Any]) -> None:
    for value in values if len(set(values)) < len(values) else ():
        if values.count(value) > 1:
            raise UsageError(f"--{name}: expects each value once, {value} is there {values.count(value)} times")
