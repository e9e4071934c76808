"""The table of algorithms, and how a name becomes a configuration, a trainer, a training run.

A variant is a row: a base algorithm and the settings in which it differs.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax

from sqt_jax import envs, lap, replay, train
from sqt_jax.agents import sac, td3, td7
from sqt_jax.config import (
    SALE_SETTINGS,
    TD7_SETTINGS,
    AgentConfig,
    Config,
    ConfigError,
    TrainConfig,
    check_agent,
    check_train,
)
from sqt_jax.names import nearest, unknown
from sqt_jax.ring import Ring
from sqt_jax.types import Agent, Environment, Replay


class Algorithm(NamedTuple):
    """A row of the table."""

    make_agent: Callable[[AgentConfig, int, int], Agent]  # (config, observation size, action size)
    settings: dict[str, Any]  # where the row differs from AgentConfig's defaults
    training: Mapping[str, Any] = MappingProxyType({})  # and from TrainConfig's
    ignores: frozenset[str] = frozenset()  # settings that have no effect
    assessed: bool = False  # TD7: LAP replay, and policy checkpoints, which take one stream of episodes
    baseline: str | None = None  # what it is compared with: the same algorithm without a penalty


TEMPERATURE = frozenset({"temperature", "learn_temperature", "squashed_log_prob"})
NOISE = frozenset({"exploration_noise", "target_noise", "target_noise_clip", "sampled_actor"})
# What has no effect with the networks of a kind.
IGNORED_WITH = {"mlp": frozenset(SALE_SETTINGS), "sale": frozenset({"tau"})}

SQT = {"penalty": "batch_std", "penalty_coef": 0.5}
SQT_TUPLE = {"penalty": "transition_std", "penalty_coef": 0.1}
TD3 = {"policy_delay": 2}
TD7 = {"policy_delay": 2, "networks": "sale"}
MAXMIN = {"ensemble_size": 4}  # https://arxiv.org/abs/2002.06487
REDQ = {"ensemble_size": 10, "reduce": "subset_min", "subset_size": 2}  # https://arxiv.org/abs/2101.05982


def _make_td3(config: AgentConfig, observation_size: int, action_size: int) -> Agent:
    if config.networks == "sale":
        return td7.make_sale_agent(config, observation_size, action_size, td3.actions(config), assessed=False)
    return td3.make(config, observation_size, action_size)


def _make_sac(config: AgentConfig, observation_size: int, action_size: int) -> Agent:
    if config.networks == "sale":
        return td7.make_sale_agent(config, observation_size, action_size, sac.actions(config), assessed=False)
    return sac.make(config, observation_size, action_size)


def _td3(settings: dict[str, Any]) -> Algorithm:
    return Algorithm(_make_td3, TD3 | settings, ignores=TEMPERATURE.union(TD7_SETTINGS))


def _sac(settings: dict[str, Any], **training: Any) -> Algorithm:
    return Algorithm(_make_sac, settings, training, ignores=NOISE.union(TD7_SETTINGS))


def _td7(settings: dict[str, Any]) -> Algorithm:
    return Algorithm(td7.make, TD7 | settings, ignores=TEMPERATURE | {"tau"}, assessed=True)


ALGORITHMS: dict[str, Algorithm] = {
    "td3": _td3({}),
    "td3_sqt": _td3(SQT)._replace(baseline="td3"),
    "td3_sqt_tuple": _td3(SQT_TUPLE)._replace(baseline="td3"),
    "sac": _sac({}),
    "sac_sqt": _sac(SQT)._replace(baseline="sac"),
    "sac_sqt_tuple": _sac(SQT_TUPLE)._replace(baseline="sac"),
    "td7": _td7({}),
    "td7_sqt": _td7(SQT)._replace(baseline="td7"),
    "td7_sqt_tuple": _td7(SQT_TUPLE)._replace(baseline="td7"),
    "maxmin": _td3(MAXMIN),
    "maxmin_sqt": _td3(MAXMIN | SQT)._replace(baseline="maxmin"),
    "redq": _sac(REDQ, updates_per_step=5),
    "redq_sqt": _sac(REDQ | SQT, updates_per_step=5)._replace(baseline="redq"),
}

AGENT_SETTINGS = frozenset(field.name for field in dataclasses.fields(AgentConfig))
TRAIN_SETTINGS = frozenset(field.name for field in dataclasses.fields(TrainConfig))


def _refuse_unknown(settings: Iterable[str], known: Iterable[str]) -> None:
    for name in settings:
        if name not in known:
            raise ConfigError(name, f"is not a setting{nearest(name, known)}")


def make_agent_config(algo: str, **settings: Any) -> AgentConfig:
    """An agent's checked settings: the defaults, then the algorithm's row, then `settings`.

    Raises:
      ConfigError: for an unknown name or a value that cannot be; the message names the setting and what it expects.
    """
    if algo not in ALGORITHMS:
        raise ConfigError("algo", unknown(algo, ALGORITHMS))
    _refuse_unknown(settings, AGENT_SETTINGS)
    if isinstance(settings.get("hidden"), list):  # out of a JSON file
        settings["hidden"] = tuple(settings["hidden"])
    row = ALGORITHMS[algo]
    config = AgentConfig(**row.settings | settings)
    own_penalty = row.settings.get("penalty", AgentConfig.penalty)
    if config.penalty != own_penalty:
        raise ConfigError("penalty", f"expects {own_penalty} for {algo}: the algorithm's name says it")
    check_agent(algo, config)
    if row.assessed and config.networks != "sale":
        raise ConfigError("networks", f"expects sale for {algo}")
    for ignored, cause in ((row.ignores, algo), (IGNORED_WITH[config.networks], f"--networks={config.networks}")):
        for name in settings:
            # The default may be named: config.json names everything.
            if name in ignored and settings[name] != getattr(AgentConfig, name):
                raise ConfigError(name.removeprefix("learn_"), f"has no effect with {cause}")
    return config


def make_config(algo: str, env: "str | Environment", **settings: Any) -> Config:
    """A whole experiment's checked settings.

    Args:
      algo: a name of `ALGORITHMS`.
      env: a name that `sqt_jax.envs.make` knows.
      **settings: fields of `AgentConfig` and `TrainConfig` by name, `physics` and `eval_physics`.

    Raises:
      ConfigError: for an unknown name or a value that cannot be; the message names the setting and what it expects.
    """
    physics, eval_physics = settings.pop("physics", None), settings.pop("eval_physics", "auto")
    training = {name: settings.pop(name) for name in TRAIN_SETTINGS & settings.keys()}
    if algo in ALGORITHMS:
        _refuse_unknown(settings, AGENT_SETTINGS | TRAIN_SETTINGS)
    agent = make_agent_config(algo, **settings)
    if isinstance(env, Environment):
        if physics is not None or eval_physics != "auto":
            raise ConfigError("physics", "has no effect with an environment of your own")
        env, physics = env.name, "own"
    if physics == "own":
        if not isinstance(env, str):
            raise ConfigError("env", "expects a name")
        known: tuple[str, ...] = ("own",)
        eval_physics = "own"
    else:
        try:
            env = envs.resolve(env)
        except ValueError as error:
            raise ConfigError("env", str(error)) from None
        known = tuple(envs.simulators(env))
    physics = physics or known[0]
    if physics not in known:
        raise ConfigError("physics", f"{unknown(physics, known)} for {env}")
    if eval_physics not in ("auto", *known):
        raise ConfigError("eval_physics", f"{unknown(eval_physics, ['auto', *known])} for {env}")
    train_config = TrainConfig(**{**ALGORITHMS[algo].training, **training})
    check_train(train_config)
    if ALGORITHMS[algo].assessed and train_config.num_envs > 1:
        raise ConfigError("num_envs", f"expects 1 for {algo}, whose policies are assessed one episode after another")
    return Config(algo, env, physics, eval_physics, agent, train_config)


def check_physics(config: Config) -> None:
    """Raises ConfigError where this machine lacks what the physics of the training or of the evaluation need.

    Not part of `make_config`: a policy that was trained elsewhere has settings too.
    """
    for setting, physics in {"physics": config.physics, "eval_physics": eval_physics_of(config)}.items():
        if missing := envs.lacks(physics):
            here = ", ".join(name for name in envs.simulators(config.env) if not envs.lacks(name))
            raise ConfigError(setting, f"{physics} needs {missing}; expects one of {here} here")


def make_agent(algo: str, observation_size: int, action_size: int, **settings: Any) -> Agent:
    """An algorithm's functions alone, for a loop and an environment of your own.

    `init`, `act` and `update` are all that td3 and sac need. td7 needs `observe` after each step of its one environment
    too, or it acts for ever as at the start, and `sqt_jax.lap` as its replay.

    Args:
      observation_size, action_size: O and A; actions are in [-1, 1].
      **settings: fields of `AgentConfig` by name.

    Raises:
      ConfigError: as `make_agent_config`.
    """
    config = make_agent_config(algo, **settings)
    return ALGORITHMS[algo].make_agent(config, observation_size, action_size)


def agent_of(config: Config, env: Environment) -> Agent:
    """The agent of an experiment, for an environment's sizes."""
    return ALGORITHMS[config.algo].make_agent(config.agent, env.observation_size, env.action_size)


def replay_of(config: Config, env: Environment) -> Replay:
    """The replay buffer of an experiment, for an environment's sizes."""
    agent, settings = config.agent, config.train
    rows = Ring(settings.capacity, env.observation_size, env.action_size, settings.num_envs, env.shortest_episode)
    if not ALGORITHMS[config.algo].assessed:
        return replay.uniform(rows, settings.batch_size)
    return lap.lap(rows, settings.batch_size, agent.priority_exponent, agent.min_priority, agent.target_update_period)


def make_trainer(config: Config, env: Environment | None = None) -> train.Trainer:
    """Training of one member as pure functions; `env` expects the place of the named environment."""
    eval_env = env
    if env is None:
        env = envs.make(config.env, config.physics)
        physics = eval_physics_of(config)
        eval_env = env if physics == config.physics else envs.make(config.env, physics)
    return train.make_trainer(agent_of(config, env), env, replay_of(config, env), config.train, eval_env)


def eval_physics_of(config: Config) -> str:
    """The physics that evaluation plays on: with `auto`, MuJoCo C where it is the faster one."""
    if config.eval_physics != "auto":
        return config.eval_physics
    faster = jax.default_backend() == "cpu" and "mujoco" in envs.simulators(config.env)
    return "mujoco" if faster else config.physics


def make_train(config: Config, env: Environment | None = None) -> Callable[..., tuple[train.TrainState, train.History]]:
    """A whole run of one member: `train(key, scalars=None) -> (state, history)`.

    `jax.jit(jax.vmap(train))(keys)` is a sweep over seeds; `scalars` of [S] arrays beside the keys sweep those too.
    Their values are traced and so not checked: `make_config` with each of them is the check (`Scalars`).
    """
    return train.make_train(make_trainer(config, env), config.train)


def memory_estimate(config: Config, num_members: int, env: Environment | None = None) -> int:
    """Bytes that a sweep of `num_members` holds on the device: the replay, and each agent twice (an update's room)."""
    env = env or envs.make(config.env, config.physics)

    def size(function: Callable, *args: Any) -> int:
        return sum(
            math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(jax.eval_shape(function, *args))
        )

    return num_members * (size(replay_of(config, env).init) + 2 * size(agent_of(config, env).init, jax.random.key(0)))
