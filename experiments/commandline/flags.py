"""A command line's text as `Options`.

A flag that is not given is absent from the result: defaults belong to the algorithms. This module checks each flag
separately; `sqt_jax.make_config` checks them together.
"""

import itertools
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from absl import flags as absl_flags

from experiments.commandline import config_file
from experiments.commandline.arguments import UsageError
from experiments.commandline.flag_table import DEFAULT_SEEDS, EXAMPLE, FLAGS, Flag, OutputConfig
from experiments.commandline.presets import PRESETS
from experiments.surroundings import paths
from sqt_jax.config import SETTINGS
from sqt_jax.job_limits import usable_cores
from sqt_jax.settings import ConfigError, Setting, settings_of
from sqt_jax.suggestions import did_you_mean

MAX_SEED = 2**32 - 1
MAX_MEMBERS = 10_000
# absl understands these in addition to the flags that are defined: a file of flags, and flags that may be unknown.
ABSL_FLAGS = ("flagfile", "undefok")
LATEST = "\n"  # the value of --resume without one: no folder on a command line has this name


class Options(NamedTuple):
    """A parsed command line. `settings` and `sweep` hold given flags only; others that were not given are None."""

    algo: str | None  # algo and env are not required with --resume=FOLDER
    env: str | None
    seeds: tuple[int, ...] | None
    settings: dict[str, Any]  # one value for all members
    sweep: dict[str, tuple[float, ...]]  # swept settings with several values, in the order of `config.SETTINGS`
    paired: bool  # the lists of `sweep` are equally long, and their i-th values belong together
    preset: str
    out: str
    name: str | None
    resume: str | None  # the folder of a run; LATEST: the latest run of these settings
    overwrite: bool
    checkpoint_every: int | None
    keep_checkpoints: int | None
    devices: int | None
    env_processes: int | None
    tensorboard: bool | None
    wandb: str | None  # a project; empty: none
    tuned: str | None
    quiet: bool

    @property
    def configurations(self) -> list[tuple[float, ...]]:
        """The values of the settings in `sweep`, a tuple per configuration, in the order of the run's members."""
        lists = self.sweep.values()
        return list(zip(*lists, strict=True) if self.paired and lists else itertools.product(*lists))


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
    # Not the global flag values: libraries define their own flags there.
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
        rest = values(_with_values(argv), known_only=False)[1:]
    except absl_flags.UnrecognizedFlagError as error:
        hint = did_you_mean(f"--{error.flagname}", [f"--{flag.name}" for flag in known]) or "; --help lists the flags"
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


def _with_values(argv: Sequence[str]) -> list[str]:
    """The words with a value for `--resume`, `--env_processes` and `--wandb` where none follows.

    A value of `--wandb` may also be true or false, as in a YAML file.
    """
    project = os.environ.get("WANDB_PROJECT") or "sqt_jax"
    values = {"resume": LATEST, "env_processes": str(usable_cores()), "wandb": project}
    switched = {"--nowandb": "--wandb=", "--wandb=false": "--wandb=", "--wandb=true": f"--wandb={project}"}
    following = [*argv[1:], "-"]
    return [
        f"{word}={values[name]}"
        if (name := word.lstrip("-")) in values and word != name and after[:1] == "-"
        else switched.get(word, word)
        for word, after in zip(argv, following, strict=True)
    ]


def _file_values(name: str) -> dict[str, Any]:
    """The flags of a YAML file, parsed as those of a command line."""
    switches = {flag.name for group in FLAGS.values() for flag in group if flag.parse is None} | {"wandb"}
    try:
        arguments = config_file.arguments(Path(paths.expanded(name)), switches)
    except (config_file.InvalidConfigFile, ValueError) as error:
        raise UsageError(f"--config={name}: {error}") from None
    try:
        return _values(["", *arguments])
    except UsageError as error:
        raise UsageError(f"{error} (in {name})") from None


def parse(argv: Sequence[str], needs_env: bool = True) -> Options | None:
    """A command line (program name first) as `Options`; None if it asks for help.

    Args:
      needs_env: whether --env is required; it is not where an environment is handed in.

    Raises:
      UsageError: a flag is unknown, missing or invalid.
    """
    given = argv[1 : argv.index("--")] if "--" in argv else argv[1:]
    if any(word in ("--help", "-help", "--h", "-h", "-?") for word in given):
        return None
    values = _values(argv)
    if "config" in values:
        values = _file_values(values.pop("config")) | values
    own = {name: values.pop(name, None) for name in ("algo", "env", "seeds", "preset", "out", "name")}
    output = {name: values.pop(name, None) for name in settings_of(OutputConfig)}
    resume, overwrite = values.pop("resume", None), values.pop("overwrite", False)
    if resume == "":
        raise UsageError("--resume=: expects the folder of a run, or nothing at all: --resume")
    folder_given = resume not in (None, LATEST)
    for required in ("algo", "env") if needs_env else ("algo",):
        if not own[required] and resume in (None, LATEST):
            raise UsageError(f"--{required}: is required, as in {EXAMPLE}")
    if resume is not None and overwrite:
        raise UsageError("--overwrite: expects no --resume: one replaces a run, the other continues it")
    for name in ("out", "name", "preset"):
        if folder_given and own[name] is not None:
            raise UsageError(f"--{name}: has no effect with --resume={resume}")
    for name, about in settings_of(OutputConfig).items():
        if output[name] is not None:
            _check(about, output[name])
    _check_project(output["wandb"] or "")

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
    out = _folder("out", "runs" if own["out"] is None else own["out"])
    if folder_given:
        resume = _folder("resume", resume)

    settings: dict[str, Any] = {}
    sweep: dict[str, tuple[float, ...]] = {}
    quiet, paired = values.pop("quiet", False), values.pop("paired", False)
    for setting, value in values.items():
        about = SETTINGS[setting]
        if about.auto and value == "auto":
            settings[about.auto] = True
            continue
        choices = value if about.swept else (value,)
        for choice in choices:
            _check(about, choice)
        if not paired:
            _reject_duplicates(setting, choices)
        if len(choices) > 1:
            sweep[setting] = choices
        else:
            settings[setting] = choices[0]
    sweep = {name: sweep[name] for name in SETTINGS if name in sweep}
    if paired:
        _check_pairs(sweep)
    lengths = [len(choices) for choices in sweep.values()]
    count = (max(lengths, default=1) if paired else math.prod(lengths)) * len(own["seeds"] or DEFAULT_SEEDS)
    if count > MAX_MEMBERS:
        raise UsageError(f"--seeds: expects at most {MAX_MEMBERS} members, seeds times swept values, not {count}")
    return Options(
        algo=own["algo"],
        env=own["env"],
        seeds=_check_seeds(own["seeds"]) if own["seeds"] is not None else None if folder_given else DEFAULT_SEEDS,
        settings=settings,
        sweep=sweep,
        paired=paired,
        preset=preset,
        out=out,
        name=name,
        resume=resume,
        overwrite=overwrite,
        quiet=quiet,
        **output,
    )


def _check(about: Setting, value: Any) -> None:
    try:
        about.check(value)
    except ConfigError as error:
        raise UsageError(str(error)) from None


def _check_pairs(sweep: Mapping[str, Sequence[float]]) -> None:
    """Raises `UsageError` unless the lists are equally long and no configuration comes twice."""
    lengths = {name: len(choices) for name, choices in sweep.items()}
    if len(set(lengths.values())) > 1:
        found = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise UsageError(f"--paired: expects lists of one length; {found}")
    pairs = list(zip(*sweep.values(), strict=True))
    for values in pairs if len(set(pairs)) < len(pairs) else ():
        if pairs.count(values) > 1:
            words = " ".join(f"--{name}={value}" for name, value in zip(sweep, values, strict=True))
            raise UsageError(f"--paired: expects each configuration once, got {words} {pairs.count(values)} times")


def _check_seeds(seeds: tuple[int, ...]) -> tuple[int, ...]:
    for seed in seeds:
        if not 0 <= seed <= MAX_SEED:
            raise UsageError(f"--seeds={seed}: expects whole numbers from 0 to {MAX_SEED}")
    _reject_duplicates("seeds", seeds)
    return seeds


def _check_project(name: str) -> None:
    if len(name) > 128 or set(name) & set("/\\#?%:") or not name.isprintable():
        raise UsageError(f"--wandb={name[:40]}: expects the name of a project, up to 128 characters without /\\#?%:")


def _folder(flag: str, text: str) -> str:
    """The folder that a flag names; a YAML file can ask for a name that no folder can have."""
    if not text or "\0" in text:
        raise UsageError(f"--{flag}={text[:40]}: expects a folder")
    try:
        path = paths.expanded(text)
        os.path.abspath(path).encode()
    except UnicodeEncodeError:  # Orbax could not write checkpoints there
        raise UsageError(f"--{flag}={text[:40]}: expects a folder whose whole path is UTF-8") from None
    except ValueError as error:
        raise UsageError(f"--{flag}={text[:40]}: {error}") from None
    return path


def _reject_duplicates(name: str, values: Sequence[Any]) -> None:
    for value in values if len(set(values)) < len(values) else ():
        if values.count(value) > 1:
            raise UsageError(f"--{name}: expects each value once, got {value} {values.count(value)} times")
