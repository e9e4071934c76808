"""The table of algorithms, and how a name becomes a configuration, an agent, a training run.

A variant is a row: a baseline and the settings in which it differs.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax

from sqt_jax import envs, lap, replay, train
from sqt_jax.agents import released, sac, td3, td7
from sqt_jax.config import SETTINGS, AgentConfig, Config, TrainConfig, check_agent, check_train
from sqt_jax.ring import Ring
from sqt_jax.settings import ConfigError, current_names, settings_of
from sqt_jax.suggestions import did_you_mean, expects_one_of
from sqt_jax.types import Agent, Environment, Parts, Replay

Build = Callable[[AgentConfig, int, int], Parts]  # (config, observation size, action size) -> the agent
OWN_PHYSICS = "own"  # the `physics` of an environment that was handed in as an object


class Algorithm(NamedTuple):
    """A row of the table."""

    build: Build  # the agent as in its paper
    build_released: Build  # the same with the settings of `agents.released`
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
    """What an algorithm has with these settings (`config.FEATURES`)."""
    found = set(row.features)
    if config.penalty != "none":
        found.add("penalty")
    if config.reduce == "subset_min":
        found.add("subset")
    if config.networks == "sale":
        found.add("sale")
        found.discard("soft_targets")
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
    _reject_unknown(settings, settings_of(AgentConfig))
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


def make_config(algo: str, env: str | Environment, **settings: Any) -> Config:
    """An experiment's checked settings.

    Args:
      algo: a name of `ALGORITHMS`.
      env: a name that `sqt_jax.make_env` knows, or an environment of your own, whose name is recorded
        with `physics="own"`.
      **settings: fields of `AgentConfig` and `TrainConfig` by name, `physics` and `eval_physics`.

    Raises:
      ConfigError: an unknown name or an invalid value; the message names the setting and what it expects.
    """
    settings = current_names(settings, SETTINGS)
    physics, eval_physics = settings.pop("physics", None), settings.pop("eval_physics", "auto")
    training = {name: settings.pop(name) for name in settings_of(TrainConfig).keys() & settings.keys()}
    if algo in ALGORITHMS:
        _reject_unknown(settings, settings_of(AgentConfig) | settings_of(TrainConfig))
    agent = make_agent_config(algo, training, **settings)
    env, physics, eval_physics = _check_env(env, physics, eval_physics)
    train_config = TrainConfig(**{**ALGORITHMS[algo].training, **training})
    check_train(train_config)
    if "checkpoints" in ALGORITHMS[algo].features and train_config.num_envs > 1:
        raise ConfigError("num_envs", f"expects 1 for {algo}, which assesses its policies one episode after another")
    return Config(algo=algo, env=env, physics=physics, eval_physics=eval_physics, agent=agent, train=train_config)


def _check_env(env: str | Environment, physics: str | None, eval_physics: str) -> tuple[str, str, str]:
    """The environment's name, what computes it, and what computes evaluation."""
    if isinstance(env, Environment) or physics == OWN_PHYSICS:
        for name, value in {"physics": physics, "eval_physics": eval_physics}.items():
            if value not in (None, "auto", OWN_PHYSICS):
                raise ConfigError(name, "has no effect with an environment of your own")
        name = env.name if isinstance(env, Environment) else env
        if not isinstance(name, str) or not name:
            raise ConfigError("env", f"expects an environment with a name, not {name!r}")
        return name, OWN_PHYSICS, OWN_PHYSICS
    if not isinstance(env, str):
        raise ConfigError("env", f"expects a name or an Environment, not {type(env).__name__}")
    try:
        env = envs.resolve(env)
    except ValueError as error:
        raise ConfigError("env", str(error)) from None
    known = envs.physics_of(env)
    physics = physics or known[0]
    if physics not in known:
        raise ConfigError("physics", f"{expects_one_of(physics, known)} for {env}")
    if eval_physics not in ("auto", *known):
        raise ConfigError("eval_physics", f"{expects_one_of(eval_physics, ['auto', *known])} for {env}")
    return env, physics, eval_physics


def _reject_unknown(settings: Iterable[str], known: Iterable[str]) -> None:
    for name in settings:
        if name not in known:
            raise ConfigError(name, f"is not a setting{did_you_mean(name, known)}")


def check_physics(config: Config) -> None:
    """Raises ConfigError if this machine lacks what the physics of the training or of the evaluation need.

    Not part of `make_config`: a policy that was trained elsewhere has settings too.
    """
    if config.physics == OWN_PHYSICS:
        return
    for setting, physics in {"physics": config.physics, "eval_physics": eval_physics_of(config)}.items():
        if missing := envs.lacks(physics):
            here = ", ".join(name for name in envs.physics_of(config.env) if not envs.lacks(name))
            raise ConfigError(setting, f"{physics} needs {missing}; expects one of {here} here")


def make_parts(algo: str, config: AgentConfig, observation_size: int, action_size: int) -> Parts:
    """An agent, and the pieces of its update for tests."""
    row = ALGORITHMS[algo]
    default = default_agent_config(algo)
    as_released = any(getattr(config, name) != getattr(default, name) for name in released.SETTINGS)
    return (row.build_released if as_released else row.build)(config, observation_size, action_size)


def make_agent(algo: str, observation_size: int, action_size: int, **settings: Any) -> Agent:
    """An algorithm's functions, for a loop and an environment of your own.

    td3 and sac need `init`, `act` and `update`. td7 also needs `observe` after each step of its one environment, or it
    acts with its initial policy for ever, and `sqt_jax.lap` as its replay.

    Args:
      observation_size, action_size: O and A; actions are in [-1, 1].
      **settings: fields of `AgentConfig` by name.

    Raises:
      ConfigError: as `make_agent_config`.
    """
    config = make_agent_config(algo, **settings)
    return make_parts(algo, config, observation_size, action_size).agent


def agent_of(config: Config, env: Environment) -> Agent:
    """The agent of an experiment, for an environment's sizes."""
    return make_parts(config.algo, config.agent, env.observation_size, env.action_size).agent


def replay_of(config: Config, env: Environment) -> Replay:
    """The replay buffer of an experiment, for an environment's sizes."""
    agent, settings = config.agent, config.train
    rows = Ring(
        settings.capacity, env.observation_size, env.action_size, settings.num_envs, env.min_mean_episode_length
    )
    if "checkpoints" not in ALGORITHMS[config.algo].features:
        return replay.uniform(rows, settings.batch_size)
    return lap.lap(rows, settings.batch_size, agent.priority_exponent, agent.min_priority, agent.target_update_period)


def make_trainer(config: Config, env: Environment | None = None) -> train.Trainer:
    """Training of one member as pure functions.

    `env` replaces the named environment, in evaluation too; it is required if the configuration is of your own one.

    Raises:
      ValueError: as `env_of`.
    """
    training_env = env_of(config, env)
    physics = eval_physics_of(config)
    same = env is not None or physics == config.physics
    eval_env = training_env if same else envs.make(config.env, physics)
    buffer = replay_of(config, training_env)
    return train.make_trainer(agent_of(config, training_env), training_env, buffer, config.train, eval_env)


def env_of(config: Config, env: Environment | None = None) -> Environment:
    """The environment of an experiment: `env` if given, else the named one.

    Raises:
      ValueError: `env` is not an `Environment`; or the configuration is of an environment of your own, and `env` is
        missing or has another name.
    """
    if not isinstance(env, Environment | None):
        raise ValueError(f"env: expects an Environment, not {type(env).__name__}")
    if config.physics == OWN_PHYSICS and (env is None or env.name != config.env):
        given = "none" if env is None else env.name
        raise ValueError(f"the configuration is of an environment of your own called {config.env}, given: {given}")
    return env or envs.make(config.env, config.physics)


def eval_physics_of(config: Config) -> str:
    """The physics of evaluation; with `auto`, MuJoCo C where it is the faster one."""
    if config.eval_physics != "auto":
        return config.eval_physics
    faster = jax.default_backend() == "cpu" and "mujoco" in envs.physics_of(config.env)
    return "mujoco" if faster else config.physics


def make_train(config: Config, env: Environment | None = None) -> Callable[..., tuple[train.TrainState, train.History]]:
    """One member's whole run: `train(key, scalars=None) -> (state, history)`.

    `jax.jit(jax.vmap(train))(keys)` is a sweep over seeds; map over `scalars` of [S] arrays too to sweep those. Their
    values are traced and therefore not checked (`Scalars`). `env` as in `make_trainer`.
    """
    return train.make_train(make_trainer(config, env), config.train)


def memory_estimate(config: Config, num_members: int, env: Environment | None = None) -> int:
    """Bytes that a sweep of `num_members` holds on the device: the replay, and each agent twice (an update's room)."""
    env = env_of(config, env)

    def size(function: Callable, *args: Any) -> int:
        leaves = jax.tree.leaves(jax.eval_shape(function, *args))
        return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in leaves)

    return num_members * (size(replay_of(config, env).init) + 2 * size(agent_of(config, env).init, jax.random.key(0)))
