"""The flags of `experiments.run`: one per setting of `sqt_jax.config`, and the run's own."""

import dataclasses
import math
import textwrap
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from experiments.commandline.presets import PRESETS
from sqt_jax.algorithms import ALGORITHMS, default_agent_config, features_of
from sqt_jax.config import FEATURES, SETTINGS, AgentConfig, Config, TrainConfig
from sqt_jax.settings import Setting, setting, settings_of

EXAMPLE = "python -m experiments.run --algo=sac_sqt --env=ant --seeds=0,1,2,3,4"
DEFAULT_SEEDS = (0, 1, 2, 3, 4)


@dataclasses.dataclass(frozen=True)
class OutputConfig:
    """How a run is recorded; a resumed run keeps these unless they are given again."""

    checkpoint_every: int = setting(
        25_000, "environment steps between checkpoints; one more at the end or if interrupted; 0: none", low=0
    )
    keep_checkpoints: int = setting(2, "how many checkpoints are kept", low=1)
    devices: int = setting(
        None,
        "devices (accelerators, or threads of a CPU) that share the members",
        low=1,
        default_text="accelerators: all that get a member; a CPU: one per member, at most 16 per core",
    )
    env_processes: int = setting(
        0,
        "processes that share the environments of Gymnasium, for slow ones; without a number: one per core; 0: none, "
        "all are stepped in this process",
        low=0,
        high=1000,
    )
    tensorboard: bool = setting(True, "also write TensorBoard events")
    wandb: str = setting(
        "",
        "also send the rows to this project of Weights & Biases, a run per member; without a name: WANDB_PROJECT or "
        "sqt_jax; --nowandb turns it off",
        default_text="off",
    )
    tuned: str = setting(
        "",
        "how the settings were tuned, for a footnote in tables: experiments.tune sets it",
        default_text="they were not",
    )


class Flag(NamedTuple):
    """One flag: how its text is parsed, and its line in --help."""

    name: str
    parse: Callable[[str], Any] | None  # None: a switch
    expects: str
    help: str
    default: str
    metavar: str = "NAME"


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


def _flag(about: Setting) -> Flag:
    """The flag of a setting. Limits are checked later: this reads the text only."""
    parse: Callable[[str], Any] | None
    if about.swept:
        parse, expects, metavar = _list_of(_number), "a number, or a list like 0.1,0.5", "X[,X...]"
        if about.auto:
            parse, expects, metavar = _numbers_or_auto, "a number, a list like 0.1,0.2, or auto", "X[,X...]|auto"
    elif about.type is bool:
        parse, expects, metavar = None, "true or false", ""
    elif about.type is int:
        parse, expects, metavar = _integer, "a whole number", "N"
    elif about.type is float:
        parse, expects, metavar = _number, "a number", "X"
    elif about.type is str:
        parse, expects, metavar = str, about.expects(), "NAME"
    else:
        parse, expects, metavar = _list_of(_integer), "whole numbers like 256,256", "N,N..."
    choices = f": {', '.join(about.choices)}" if about.choices and about.choices[0] not in about.help else ""
    swept = "; may be swept" if about.swept else ""
    default = about.default_text or default_text(about)
    return Flag(
        name=about.name,
        parse=parse,
        expects=expects,
        help=f"{about.help}{choices}{swept}",
        default=default,
        metavar=metavar,
    )


def default_text(about: Setting) -> str:
    """A setting's default, and the other defaults of algorithms' rows: `1; 2 for td3, td7`."""
    values: dict[str, Any] = {}
    for algo, row in ALGORITHMS.items():
        config = default_agent_config(algo)
        if set(about.features) <= features_of(row, config):
            own = getattr(config, about.name, about.default)
            values[algo] = row.training.get(about.name, own)
    texts = {algo: _text(value) for algo, value in values.items()}
    default = _text(about.default)
    if texts and default not in texts.values():  # no algorithm has it
        default = ""
    groups: dict[str, list[str]] = {}
    for algo, text in _by_kind(texts).items():
        groups.setdefault(text, []).append(algo)
    others = [f"{text} for {', '.join(names)}" for text, names in groups.items() if text != default]
    return "; ".join(filter(None, [default, *others]))


def _by_kind(texts: Mapping[str, str]) -> dict[str, str]:
    """The texts under fewer names: by baseline if its variants agree, else by ending (`_sqt`) if those agree."""

    def baseline(algo: str) -> str:
        return ALGORITHMS[algo].baseline or algo

    def ending(algo: str) -> str:
        return algo.removeprefix(baseline(algo))

    for kind in (baseline, ending):
        found: dict[str, set[str]] = {}
        for algo, text in texts.items():
            found.setdefault(kind(algo), set()).add(text)
        if all(len(values) == 1 for values in found.values()) and "" not in found:
            return {name: values.pop() for name, values in found.items()}
    return dict(texts)


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _group(settings: Iterable[Setting], feature: str | None) -> list[Flag]:
    return [_flag(s) for s in settings if s.flag == s.name and (s.features[:1] or (None,))[0] == feature]


def _flags() -> dict[str, list[Flag]]:
    agent = settings_of(AgentConfig).values()
    return {
        "What to run": [
            Flag(
                name="algo", parse=str, expects="a name", help=f"algorithm: {', '.join(ALGORITHMS)}", default="required"
            ),
            Flag(
                name="env",
                parse=str,
                expects="a name",
                help="environment: cheetah, walker, ant, humanoid, hopper, swimmer or humanoid_standup (Gymnasium's "
                "v4); NAME-v5 for its v5; brax:ant and others for Brax's own; playground:NAME for MuJoCo Playground's; "
                "gym:ID: any environment that Gymnasium makes; MODULE:FUNCTION: your function that returns a "
                "sqt_jax.Environment or a gymnasium.Env",
                default="required",
            ),
            *_group(settings_of(Config).values(), None),
            Flag(
                name="seeds",
                parse=_list_of(_integer),
                expects="whole numbers like 0,1,2",
                help="random seeds; each is a member, times the values of swept settings",
                default=_text(DEFAULT_SEEDS),
                metavar="N,N...",
            ),
            Flag(
                name="paired",
                parse=None,
                expects="true or false",
                help="pair the lists of swept settings: the first values of all lists, the second values, and so on, "
                "instead of every combination",
                default="false",
            ),
            Flag(
                name="preset",
                parse=str,
                expects=f"one of {', '.join(PRESETS)}",
                help=f"named settings: {', '.join(PRESETS)}",
                default="paper",
            ),
            Flag(
                name="config",
                parse=str,
                expects="a file",
                help="YAML file of flags without the dashes; it overrides the preset",
                default="none",
            ),
        ],
        "Training": _group(settings_of(TrainConfig).values(), None),
        "Algorithm": _group(agent, None),
        **{f"With {title}": _group(agent, feature) for feature, title in FEATURES.items()},
        "Output": [
            Flag(name="out", parse=str, expects="a folder", help="results go to OUT/ENV/ALGO/NAME/", default="runs"),
            Flag(
                name="name",
                parse=str,
                expects="a word",
                help="name of the run",
                default="settings that differ from the defaults, and the time",
            ),
            Flag(
                name="resume",
                parse=str,
                expects="the folder of a run, or nothing: the latest run of the same settings, or the run --name",
                help="continue a run from its last checkpoint; --steps may be raised",
                default="off",
            ),
            Flag(
                name="overwrite",
                parse=None,
                expects="true or false",
                help="replace a run of the same name",
                default="false",
            ),
            *_group(settings_of(OutputConfig).values(), None),
            Flag(name="quiet", parse=None, expects="true or false", help="print errors only", default="false"),
            Flag(name="help", parse=None, expects="true or false", help="this text", default=""),
        ],
    }


FLAGS: dict[str, list[Flag]] = _flags()


def help_text() -> str:
    """The text of --help."""
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
            head = f"  --{flag.name}" if flag.parse is None else f"  --{flag.name}={flag.metavar}"
            body = textwrap.wrap(flag.help + default, width=78)
            lines.append(f"{head:<30} {body[0]}")
            lines += [f"{'':<30} {more}" for more in body[1:]]
    swept = ", ".join(name for name, about in SETTINGS.items() if about.swept)
    lines += [
        "",
        "In brackets: the default. A switch is turned off by --noNAME.",
        f"A setting that may be swept ({swept}) may be a list:",
        "the members of the run are all combinations of their values (--paired: the pairs) times the seeds.",
        "Exit codes: 0 done, 1 the results could not be written, 2 bad usage, 3 a member diverged, 130 interrupted.",
    ]
    return "\n".join(lines)
