"""The command line's flags: one per setting of `sqt_jax.config`, and a few of the run's own.

A flag that is not given is absent from the result: defaults belong to the algorithms. What is checked here needs
nothing but the text of the command line, so that a typing error is answered before any heavy import; the limits of
the settings are `sqt_jax.algorithms.make_config`'s.
"""

import dataclasses
import math
import os
import re
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from absl import flags as absl_flags

from experiments import config_file
from experiments.presets import PRESETS
from sqt_jax.config import SALE_SETTINGS, TD7_SETTINGS, AgentConfig, Config, ConfigError, TrainConfig, check_value
from sqt_jax.names import nearest
from sqt_jax.types import Scalars

EXAMPLE = "python -m experiments.run --algo=sac_sqt --env=ant --seeds=0,1,2,3,4"
DEFAULT_SEEDS = (0, 1, 2, 3, 4)
MAX_SEED = 2**32 - 1
MAX_MEMBERS = 10_000
# What absl understands beside the flags that are defined: another file of flags, and flags that may be unknown.
ABSL_FLAGS = ("flagfile", "undefok")
# The run's own flags that a resumed run takes over; the smallest value of each.
OUTPUT = {"checkpoint_every": 0, "keep_checkpoints": 1, "devices": 1, "tensorboard": False}
CHECKPOINT_EVERY = 25_000
LATEST = "\n"  # no folder's name on a command line
KEEP_CHECKPOINTS = 2

# What each setting is, for --help: a new field of the configuration becomes a flag by itself and wants a line here.
SETTING_HELP = {
    "physics": "what computes the environment's physics: mjx, mujoco, warp; brax:ENV has others",
    "eval_physics": "the same for evaluation; auto: mujoco on a CPU, else the training's",
    "steps": "environment steps per member",
    "warmup_steps": "first steps, with uniform random actions and no updates",
    "batch_size": "transitions per update",
    "replay_capacity": "transitions kept per member",
    "num_envs": "environments in lockstep per member",
    "updates_per_step": "updates per transition",
    "eval_every": "environment steps between evaluations",
    "eval_episodes": "episodes per evaluation",
    "penalty_coef": "weight of the disagreement penalty, the paper's alpha",
    "ddof": "the std over critics divides by N - ddof",
    "penalty_inside_gamma": "discount and mask the penalty with the bootstrapped value",
    "reduce": "how the target critics' values become one: min, mean or subset_min (REDQ)",
    "subset_size": "critics drawn per update by --reduce=subset_min",
    "ensemble_size": "number of critics",
    "hidden": "widths of the hidden layers",
    "networks": "mlp, or sale: TD7's, with its critic loss, value bounds and hard target copies (SAC's next action is "
    "then the target actor's)",
    "lr": "Adam's learning rate",
    "gamma": "discount factor",
    "tau": "soft-update rate of the target networks",
    "policy_delay": "critic updates per actor update",
    "actor_reduce": "what the actor maximises of the critics: mean, min or first",
    "exploration_noise": "TD3, TD7: std of the noise on actions",
    "target_noise": "TD3, TD7: std of the noise on target actions",
    "target_noise_clip": "TD3, TD7: limit of that noise",
    "sampled_actor": "TD3, TD7: a Gaussian actor, updated by its samples; its mode acts",
    "temperature": "SAC: weight of the entropy; 'auto' learns it from 0.2 on",
    "squashed_log_prob": "SAC: log-probabilities are the action's; else the Gaussian's, averaged over dimensions",
    "train_encoder": "train the encoder of the embeddings; else it stays as it started",
    "value_clipping": "clip the bootstrapped value to the range of the targets seen so far",
    "embedding_size": "size of the state and state-action embeddings",
    "target_update_period": "updates between copies into the target networks",
    "priority_exponent": "replay: a transition's priority is its TD error to this power",
    "min_priority": "TD error below which all priorities are equal and the critics' loss is quadratic",
    "checkpoint_switch": "updates after which a policy is assessed by several episodes instead of one",
    "assessment_episodes": "episodes of an assessment from then on",
    "checkpoint_reset_weight": "factor of the best assessment so far at that switch",
}
# Chosen by --algo and by --temperature=auto, or not a setting of its own.
NOT_FLAGS = ("penalty", "learn_temperature", "algo", "env", "agent", "train")
# Where the algorithms' own defaults differ from the dataclass's.
DEFAULT_TEXT = {
    "penalty_coef": "0.5 with _sqt, 0.1 with _sqt_tuple",
    "policy_delay": "2; 1 for sac and redq",
    "ensemble_size": "2; 4 for maxmin, 10 for redq",
    "reduce": "min; subset_min for redq",
    "updates_per_step": "1; 5 for redq",
    "networks": "mlp; sale for td7",
}


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


class UsageError(ValueError):
    """A command line that cannot be. The text is one line that names the flag."""


class _Flag(NamedTuple):
    name: str
    parse: Callable[[str], Any] | None  # None: a switch
    takes: str
    help: str
    default: str


def _integer(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        value = float(text)  # 1e6
        if not value.is_integer():
            raise ValueError from None
        return int(value)


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError
    return value


def _list_of(parse: Callable[[str], Any]) -> Callable[[str], tuple[Any, ...]]:
    def parse_list(text: str) -> tuple[Any, ...]:
        return tuple(parse(item.strip()) for item in text.split(","))

    return parse_list


def _numbers_or_auto(text: str) -> tuple[float, ...] | str:
    return "auto" if text.strip() == "auto" else _list_of(_number)(text)


def _setting_flag(field: dataclasses.Field) -> _Flag:
    """The flag of one field of the configuration, by the type of its default."""
    default = str(field.default)
    parse: Callable[[str], Any] | None
    if field.name == "temperature":
        parse, takes = _numbers_or_auto, "a number, a list like 0.1,0.2, or auto"
    elif field.name in Scalars._fields:
        parse, takes = _list_of(_number), "a number, or a list like 0.1,0.5"
    elif isinstance(field.default, bool):
        parse, takes, default = None, "true or false", default.lower()
    elif isinstance(field.default, int):
        parse, takes = _integer, "a whole number"
    elif isinstance(field.default, float):
        parse, takes = _number, "a number"
    elif isinstance(field.default, tuple):
        parse, takes, default = _list_of(_integer), "whole numbers like 256,256", ",".join(map(str, field.default))
    else:
        parse, takes = str, "a word"
    return _Flag(field.name, parse, takes, SETTING_HELP.get(field.name, ""), DEFAULT_TEXT.get(field.name, default))


def _settings(config: type) -> list[_Flag]:
    return [_setting_flag(field) for field in dataclasses.fields(config) if field.name not in NOT_FLAGS]


FLAGS: dict[str, list[_Flag]] = {
    "What to run": [
        _Flag(
            "algo",
            str,
            "a name",
            "algorithm: td3, sac or td7, alone or with _sqt or _sqt_tuple; maxmin or redq, alone or with _sqt",
            "required",
        ),
        _Flag(
            "env",
            str,
            "a name",
            "environment: cheetah, walker, ant, humanoid, hopper, swimmer or humanoid_standup (Gymnasium's v4); "
            "NAME-v5 for its v5; brax:ant and others for Brax's own",
            "required",
        ),
        *_settings(Config),
        _Flag(
            "seeds",
            _list_of(_integer),
            "whole numbers like 0,1,2",
            "random seeds, one member each (times the values of swept settings)",
            ",".join(map(str, DEFAULT_SEEDS)),
        ),
        _Flag("preset", str, f"one of {', '.join(PRESETS)}", "bundle of settings; flags win over it", "paper"),
        _Flag("config", str, "a file", "YAML file of flags without the dashes; it wins over the preset", "none"),
    ],
    "Training": _settings(TrainConfig),
    "Algorithm (the scalars " + ", ".join(Scalars._fields) + " take lists)": [
        flag for flag in _settings(AgentConfig) if flag.name not in SALE_SETTINGS + TD7_SETTINGS
    ],
    "SALE networks (TD7; --networks=sale)": [flag for flag in _settings(AgentConfig) if flag.name in SALE_SETTINGS],
    "TD7": [flag for flag in _settings(AgentConfig) if flag.name in TD7_SETTINGS],
    "Output": [
        _Flag("out", str, "a folder", "results go to OUT/ENV/ALGO/NAME/", "runs"),
        _Flag("name", str, "a word", "name of the run", "settings that differ from the defaults, and the time"),
        _Flag(
            "resume",
            str,
            "the folder of a run, or nothing: the latest run of the same settings, or the one called --name",
            "go on with a run where its last checkpoint is; --steps may be raised",
            "off",
        ),
        _Flag("overwrite", None, "true or false", "replace a run of the same name", "false"),
        _Flag(
            "checkpoint_every",
            _integer,
            "a whole number",
            "environment steps between checkpoints, which are also made at the end and where the run is interrupted; "
            "0: none at all",
            str(CHECKPOINT_EVERY),
        ),
        _Flag("keep_checkpoints", _integer, "a whole number", "how many are kept", str(KEEP_CHECKPOINTS)),
        _Flag(
            "devices",
            _integer,
            "a whole number",
            "devices (accelerators, or a CPU's threads) that the members are spread over",
            "accelerators: all that get a member of their own; a CPU: one for each member, up to 16 for a core",
        ),
        _Flag("tensorboard", None, "true or false", "also write TensorBoard events", "true"),
        _Flag("quiet", None, "true or false", "print errors only", "false"),
        _Flag("help", None, "true or false", "this text", ""),
    ],
}


class _Parser(absl_flags.ArgumentParser):
    def __init__(self, flag: _Flag):
        self.flag = flag
        self.syntactic_help = flag.takes

    def parse(self, argument: str) -> Any:
        assert self.flag.parse is not None
        try:
            return self.flag.parse(argument)
        except (ValueError, OverflowError):
            raise ValueError(f"takes {self.flag.takes}") from None


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
        text = re.sub(r"\('Non-boolean argument to boolean flag', .*\)", "takes true or false", text)
        missing = re.fullmatch(r"Missing value for flag -*(\w+)", text)
        if missing:
            takes = next(flag.takes for flag in known if flag.name == missing[1])
            text = f"--{missing[1]}: takes {takes}"
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
    except config_file.Refused as error:
        raise UsageError(f"--config={name}: {error}") from None
    try:
        return _values(["", *arguments])
    except UsageError as error:
        raise UsageError(f"{error} (in {name})") from None


def parse(argv: Sequence[str]) -> Options | None:
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
        raise UsageError("--resume=: takes the folder of a run, or nothing at all: --resume")
    folder_given = resume not in (None, LATEST)
    for required in ("algo", "env"):
        if not own[required] and resume in (None, LATEST):
            raise UsageError(f"--{required}: is required, as in {EXAMPLE}")
    if resume is not None and overwrite:
        raise UsageError("--overwrite: takes no --resume beside it: the one replaces a run, the other goes on with it")
    for name in ("out", "name", "preset"):
        if folder_given and own[name] is not None:
            raise UsageError(f"--{name}: has no effect with --resume={resume}")
    for name, lowest in OUTPUT.items():
        if output[name] is not None and output[name] < lowest:
            raise UsageError(f"--{name}: takes a whole number of at least {lowest}, not {output[name]}")

    preset = own["preset"] or "paper"
    if preset not in PRESETS:
        raise UsageError(f"--preset={preset}: takes one of {', '.join(PRESETS)}")

    name = own["name"]
    if name is not None and (
        name in ("", ".", "..")
        or name[0] == "-"
        or set(name) & set("/\\")
        or not name.isprintable()
        or len(name.encode()) > 200
    ):
        raise UsageError(
            f"--name={name[:40]}: takes up to 200 bytes, no slashes or control characters: it names a folder"
        )
    for flag, folder in (("out", own["out"]), ("resume", resume if folder_given else None)):
        if folder is not None and not (folder and _is_path(folder)):
            raise UsageError(f"--{flag}={folder[:40]}: takes a folder")

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
        raise UsageError(f"--seeds: takes at most {MAX_MEMBERS} members, seeds times swept values, not {count}")
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
            raise UsageError(f"--seeds={seed}: takes whole numbers from 0 to {MAX_SEED}")
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
            raise UsageError(f"--{name}: takes each value once, {value} is there {values.count(value)} times")


def help_text() -> str:
    """What --help prints."""
    lines = [
        "Train an ensemble actor-critic with or without SQT, several seeds and settings at once.",
        "",
        f"  {EXAMPLE}",
        "  python -m experiments.run --algo=td3_sqt --env=cheetah --seeds=0,1 --penalty_coef=0.1,0.5 --preset=quick",
        "  python -m experiments.run --resume=runs/ant/sac_sqt/20250102T030405Z",
    ]
    for group, rows in FLAGS.items():
        lines += ["", f"{group}:"]
        for flag in rows:
            default = f" ({flag.default})" if flag.default else ""
            head = f"  --{flag.name}" if flag.parse is None else f"  --{flag.name}={_metavar(flag)}"
            body = textwrap.wrap(flag.help + default, width=78)
            lines.append(f"{head:<30} {body[0]}")
            lines += [f"{'':<30} {more}" for more in body[1:]]
    lines += [
        "",
        "In brackets: the default. A switch is turned off by --noNAME. A setting with a list is swept: the members of",
        "the run are all its values times the seeds. Exit codes: 0 done, 2 bad usage, 3 a member diverged,",
        "130 interrupted.",
    ]
    return "\n".join(lines)


def _metavar(flag: _Flag) -> str:
    if flag.name == "temperature":
        return "X[,X...]|auto"
    if flag.takes.startswith("a number, "):
        return "X[,X...]"
    return {"a number": "X", "a whole number": "N"}.get(flag.takes, "N,N..." if "numbers" in flag.takes else "NAME")
