"""The table of algorithms, and how a name becomes an agent.

A variant is a row: a baseline and the settings in which it differs.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from sqt_jax.agents import normalised, released, sac, td3, td7
from sqt_jax.config import SETTINGS, AgentConfig, TrainConfig, check_agent
from sqt_jax.settings import ConfigError, settings_of
from sqt_jax.suggestions import did_you_mean, expects_one_of
from sqt_jax.types import Agent, Parts

Build = Callable[[AgentConfig, int, int], Parts]  # (config, observation size, action size) -> the agent


class Algorithm(NamedTuple):
    """A row of the table."""

    build: Build  # the agent as in its paper
    build_released: Build  # the authors' released code: used if a setting of `released.SETTINGS` is changed
    features: frozenset[str]  # of `config.FEATURES`; a penalty, a subset and --networks add theirs
    settings: Mapping[str, Any]  # where the row differs from AgentConfig's defaults
    training: Mapping[str, Any] = MappingProxyType({})  # and from TrainConfig's
    # Agent settings that equal a training setting unless they are given.
    follows: Mapping[str, str] = MappingProxyType({})
    baseline: str | None = None  # the algorithm that it is compared with: the same without a penalty

    def but(self, **settings: Any) -> "Algorithm":
        """The row with other agent settings."""
        return self._replace(settings={**self.settings, **settings})


TD3 = Algorithm(
    build=td3.build,
    build_released=released.build_td3,
    features=frozenset({"noise", "soft_targets"}),
    settings={"policy_delay": 2},
)
SAC = Algorithm(
    build=sac.build,
    build_released=released.build_sac,
    features=frozenset({"entropy", "soft_targets"}),
    settings={},
)
TD7 = Algorithm(
    build=td7.build,
    build_released=released.build_td7,
    features=frozenset({"noise", "checkpoints"}),
    settings={"policy_delay": 2, "networks": "sale"},
)
BASELINES = {
    "td3": TD3,
    "sac": SAC,
    "td7": TD7,
    "maxmin": TD3.but(ensemble_size=4),  # https://arxiv.org/abs/2002.06487
    # https://arxiv.org/abs/2101.05982: several critic updates and one actor update per environment step
    "redq": SAC.but(ensemble_size=10, reduce="subset_min", subset_size=2)._replace(
        training={"updates_per_step": 5}, follows={"policy_delay": "updates_per_step"}
    ),
}


def variant(baseline: str, **settings: Any) -> Algorithm:
    """A row that differs from its baseline in these agent settings: the penalty and its coefficient."""
    return BASELINES[baseline].but(**settings)._replace(baseline=baseline)


SQT = {"penalty": "batch_std", "penalty_coef": 0.5}  # eq. 20
SQT_TUPLE = {"penalty": "transition_std", "penalty_coef": 0.1}  # eq. 19

ALGORITHMS: dict[str, Algorithm] = {
    "td3": BASELINES["td3"],
    "td3_sqt": variant("td3", **SQT),
    "td3_sqt_tuple": variant("td3", **SQT_TUPLE),
    "sac": BASELINES["sac"],
    "sac_sqt": variant("sac", **SQT),
    "sac_sqt_tuple": variant("sac", **SQT_TUPLE),
    "td7": BASELINES["td7"],
    "td7_sqt": variant("td7", **SQT),
    "td7_sqt_tuple": variant("td7", **SQT_TUPLE),
    "maxmin": BASELINES["maxmin"],
    "maxmin_sqt": variant("maxmin", **SQT),
    "redq": BASELINES["redq"],
    "redq_sqt": variant("redq", **SQT),
}


def features_of(row: Algorithm, config: AgentConfig) -> frozenset[str]:
    """The features of an algorithm with these settings (`config.FEATURES`)."""
    found = set(row.features)
    if config.penalty != "none":
        found.add("penalty")
    if config.reduce == "subset_min":
        found.add("subset")
    if config.networks == "sale":
        found.add("sale")
        found.discard("soft_targets")
    else:
        found.add("mlp")
    return frozenset(found)


def default_agent_config(algo: str, training: Mapping[str, Any] = MappingProxyType({})) -> AgentConfig:
    """An algorithm's own settings: AgentConfig's defaults and the row. `training` are training settings if given."""
    row = ALGORITHMS[algo]
    known = {name: about.default for name, about in settings_of(TrainConfig).items()} | {**row.training, **training}
    follows = {name: known[source] for name, source in row.follows.items()}
    return AgentConfig(**{**row.settings, **follows})


def make_agent_config(algo: str, training: Mapping[str, Any] = MappingProxyType({}), **settings: Any) -> AgentConfig:
    """An agent's checked settings: the defaults, then the algorithm's row, then `settings`.

    Raises:
      ConfigError: an unknown name or an invalid value; the message names the setting and what it expects.
    """
    if algo not in ALGORITHMS:
        raise ConfigError("algo", expects_one_of(algo, ALGORITHMS))
    reject_unknown(settings, settings_of(AgentConfig))
    if isinstance(settings.get("hidden"), list):  # from a JSON file
        settings["hidden"] = tuple(settings["hidden"])
    row, default = ALGORITHMS[algo], default_agent_config(algo, training)
    config = dataclasses.replace(default, **settings)
    if config.penalty != default.penalty:
        raise ConfigError("penalty", f"expects {default.penalty} for {algo}: the algorithm's name says it")
    check_agent(algo, config)
    if "checkpoints" in row.features and config.networks != "sale":
        raise ConfigError("networks", f"expects sale for {algo}")
    own, active = features_of(row, default), features_of(row, config)
    for name in settings:
        about = SETTINGS[name]
        missing = [feature for feature in about.features if feature not in active]
        # config.json names every setting, with its default where it has no effect.
        if missing and settings[name] != about.default:
            by_setting = {"subset": f"--reduce={config.reduce}", "sale": f"--networks={config.networks}"}
            by_setting["soft_targets"] = by_setting["sale"]
            chosen = missing[0] in by_setting and (missing[0] in own or missing[0] != "soft_targets")
            cause = by_setting[missing[0]] if chosen else algo
            raise ConfigError(about.flag or name, f"has no effect with {cause}")
    return config


def reject_unknown(settings: Iterable[str], known: Iterable[str]) -> None:
    for name in settings:
        if name not in known:
            raise ConfigError(name, f"is not a setting{did_you_mean(name, known)}")


def make_parts(algo: str, config: AgentConfig, observation_size: int, action_size: int) -> Parts:
    """An agent, and the pieces of its update for tests."""
    row = ALGORITHMS[algo]
    default = default_agent_config(algo)
    as_released = any(getattr(config, name) != getattr(default, name) for name in released.SETTINGS)
    parts = (row.build_released if as_released else row.build)(config, observation_size, action_size)
    # With policy checkpoints it is the learner inside them that is normalised (`td7.with_checkpoints`).
    normalise = config.normalize_observations and "checkpoints" not in row.features
    return normalised.around(parts, observation_size) if normalise else parts


def make_agent(algo: str, observation_size: int, action_size: int, **settings: Any) -> Agent:
    """An algorithm's functions, for a loop and an environment of your own.

    td3 and sac need `init`, `act` and `update`. td7 also needs `observe` after each step of its one environment, or it
    keeps acting with its initial policy, and `sqt_jax.lap` as its replay. `normalize_observations` needs `see` before
    each step.

    Args:
      observation_size, action_size: O and A; actions are in [-1, 1].
      **settings: fields of `AgentConfig` by name.

    Raises:
      ConfigError: as `make_agent_config`.
    """
    config = make_agent_config(algo, **settings)
    return make_parts(algo, config, observation_size, action_size).agent
