"""Which flags the command line has: one per setting of `sqt_jax.config`, and a few of the run's own."""

import dataclasses
import math
import textwrap
from collections.abc import Callable
from typing import Any, NamedTuple

from experiments.commandline.presets import PRESETS
from sqt_jax.config import SALE_SETTINGS, TD7_SETTINGS, AgentConfig, Config, TrainConfig
from sqt_jax.types import Scalars

EXAMPLE = "python -m experiments.run --algo=sac_sqt --env=ant --seeds=0,1,2,3,4"
DEFAULT_SEEDS = (0, 1, 2, 3, 4)
CHECKPOINT_EVERY = 25_000
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


class Flag(NamedTuple):
    name: str
    parse: Callable[[str], Any] | None  # None: a switch
    expects: str
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


def _setting_flag(field: dataclasses.Field) -> Flag:
    """The flag of one field of the configuration, by the type of its default."""
    default = str(field.default)
    parse: Callable[[str], Any] | None
    if field.name == "temperature":
        parse, expects = _numbers_or_auto, "a number, a list like 0.1,0.2, or auto"
    elif field.name in Scalars._fields:
        parse, expects = _list_of(_number), "a number, or a list like 0.1,0.5"
    elif isinstance(field.default, bool):
        parse, expects, default = None, "true or false", default.lower()
    elif isinstance(field.default, int):
        parse, expects = _integer, "a whole number"
    elif isinstance(field.default, float):
        parse, expects = _number, "a number"
    elif isinstance(field.default, tuple):
        parse, expects, default = _list_of(_integer), "whole numbers like 256,256", ",".join(map(str, field.default))
    else:
        parse, expects = str, "a word"
    return Flag(field.name, parse, expects, SETTING_HELP.get(field.name, ""), DEFAULT_TEXT.get(field.name, default))


def _settings(config: type) -> list[Flag]:
    return [_setting_flag(field) for field in dataclasses.fields(config) if field.name not in NOT_FLAGS]


FLAGS: dict[str, list[Flag]] = {
    "What to run": [
        Flag(
            "algo",
            str,
            "a name",
            "algorithm: td3, sac or td7, alone or with _sqt or _sqt_tuple; maxmin or redq, alone or with _sqt",
            "required",
        ),
        Flag(
            "env",
            str,
            "a name",
            "environment: cheetah, walker, ant, humanoid, hopper, swimmer or humanoid_standup (Gymnasium's v4); "
            "NAME-v5 for its v5; brax:ant and others for Brax's own",
            "required",
        ),
        *_settings(Config),
        Flag(
            "seeds",
            _list_of(_integer),
            "whole numbers like 0,1,2",
            "random seeds, one member each (times the values of swept settings)",
            ",".join(map(str, DEFAULT_SEEDS)),
        ),
        Flag("preset", str, f"one of {', '.join(PRESETS)}", "bundle of settings; flags win over it", "paper"),
        Flag("config", str, "a file", "YAML file of flags without the dashes; it wins over the preset", "none"),
    ],
    "Training": _settings(TrainConfig),
    "Algorithm (the scalars " + ", ".join(Scalars._fields) + " take lists)": [
        flag for flag in _settings(AgentConfig) if flag.name not in SALE_SETTINGS + TD7_SETTINGS
    ],
    "SALE networks (TD7; --networks=sale)": [flag for flag in _settings(AgentConfig) if flag.name in SALE_SETTINGS],
    "TD7": [flag for flag in _settings(AgentConfig) if flag.name in TD7_SETTINGS],
    "Output": [
        Flag("out", str, "a folder", "results go to OUT/ENV/ALGO/NAME/", "runs"),
        Flag("name", str, "a word", "name of the run", "settings that differ from the defaults, and the time"),
        Flag(
            "resume",
            str,
            "the folder of a run, or nothing: the latest run of the same settings, or the one called --name",
            "go on with a run where its last checkpoint is; --steps may be raised",
            "off",
        ),
        Flag("overwrite", None, "true or false", "replace a run of the same name", "false"),
        Flag(
            "checkpoint_every",
            _integer,
            "a whole number",
            "environment steps between checkpoints, which are also made at the end and where the run is interrupted; "
            "0: none at all",
            str(CHECKPOINT_EVERY),
        ),
        Flag("keep_checkpoints", _integer, "a whole number", "how many are kept", str(KEEP_CHECKPOINTS)),
        Flag(
            "devices",
            _integer,
            "a whole number",
            "devices (accelerators, or a CPU's threads) that the members are spread over",
            "accelerators: all that get a member of their own; a CPU: one for each member, up to 16 for a core",
        ),
        Flag("tensorboard", None, "true or false", "also write TensorBoard events", "true"),
        Flag("quiet", None, "true or false", "print errors only", "false"),
        Flag("help", None, "true or false", "this text", ""),
    ],
}


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
        "the run are all its values times the seeds.",
        "Exit codes: 0 done, 1 the results could not be written, 2 bad usage, 3 a member diverged, 130 interrupted.",
    ]
    return "\n".join(lines)


def _metavar(flag: Flag) -> str:
    if flag.name == "temperature":
        return "X[,X...]|auto"
    if flag.expects.startswith("a number, "):
        return "X[,X...]"
    return {"a number": "X", "a whole number": "N"}.get(flag.expects, "N,N..." if "numbers" in flag.expects else "NAME")
