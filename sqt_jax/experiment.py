"""An experiment: a name, an environment and settings become a configuration, an agent, a training run."""

import math
from collections.abc import Callable
from typing import Any

import jax

from sqt_jax import envs, lap, replay, train
from sqt_jax.algorithms import ALGORITHMS, make_agent_config, make_parts, reject_unknown
from sqt_jax.config import SETTINGS, AgentConfig, Config, TrainConfig, check_train
from sqt_jax.envs import env_args, gym_ids
from sqt_jax.ring import Ring
from sqt_jax.settings import ConfigError, current_names, settings_of
from sqt_jax.suggestions import expects_one_of
from sqt_jax.types import Agent, Environment, Replay

OWN_PHYSICS = "own"  # the `physics` of an environment that was handed in as an object


def make_config(algo: str, env: str | Environment, **settings: Any) -> Config:
    """An experiment's checked settings.

    Args:
      algo: a name of `ALGORITHMS`.
      env: a name that `sqt_jax.make_env` knows, or an environment of your own, whose name is recorded
        with `physics="own"`.
      **settings: fields of `AgentConfig` and `TrainConfig` by name, `physics`, `eval_physics`, `env_args` and
        `max_episode_steps`.

    Raises:
      ConfigError: an unknown name or an invalid value; the message names the setting and what it expects.
    """
    settings = current_names(settings, SETTINGS)
    physics, eval_physics = settings.pop("physics", None), settings.pop("eval_physics", "auto")
    given = settings.keys() & {"env_args", "max_episode_steps"}
    arguments: dict[str, Any] = {name: settings.pop(name) for name in given}
    training = {name: settings.pop(name) for name in settings_of(TrainConfig).keys() & settings.keys()}
    if algo in ALGORITHMS:
        reject_unknown(settings, settings_of(AgentConfig) | settings_of(TrainConfig))
    agent = make_agent_config(algo, training, **settings)
    env, physics, eval_physics = _check_env(env, physics, eval_physics)
    train_config = TrainConfig(**{**ALGORITHMS[algo].training, **training})
    check_train(train_config)
    if "checkpoints" in ALGORITHMS[algo].features and train_config.num_envs > 1:
        raise ConfigError("num_envs", f"expects 1 for {algo}, which assesses its policies one episode after another")
    _check_arguments(env, physics, arguments)
    return Config(
        algo=algo,
        env=env,
        physics=physics,
        eval_physics=eval_physics,
        **arguments,
        agent=agent,
        train=train_config,
    )


def _check_arguments(env: str, physics: str, arguments: dict[str, Any]) -> None:
    """Raises ConfigError if the environment takes no `env_args` or `max_episode_steps`, or not these."""
    for name, value in arguments.items():
        SETTINGS[name].check(value)
        if value and physics != OWN_PHYSICS and not envs.takes_arguments(env):
            raise ConfigError(name, f"has no effect with {env}")
    try:
        env_args.parse(arguments.get("env_args", ""))
    except ValueError as error:
        raise ConfigError("env_args", str(error)) from None


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


def check_physics(config: Config) -> None:
    """Raises ConfigError if the physics of training or evaluation cannot run on this machine.

    Not part of `make_config`: a policy that was trained elsewhere has settings too.
    """
    if config.physics == OWN_PHYSICS:
        return
    for setting, physics in {"physics": config.physics, "eval_physics": eval_physics_of(config)}.items():
        if missing := envs.lacks(physics):
            here = ", ".join(name for name in envs.physics_of(config.env) if not envs.lacks(name))
            raise ConfigError(setting, f"{physics} needs {missing}; expects one of {here} here")


def eval_physics_of(config: Config) -> str:
    """The physics of evaluation; with `auto`, MuJoCo C where it is the faster one."""
    if config.eval_physics != "auto":
        return config.eval_physics
    faster = jax.default_backend() == "cpu" and "mujoco" in envs.physics_of(config.env)
    return "mujoco" if faster else config.physics


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
    return env or named_env(config, config.physics)


def named_env(config: Config, physics: str, processes: int = 0, in_program: bool = True) -> Environment:
    """The environment that a configuration names.

    Args:
      processes: of environments on the host (`envs.host`), the processes that share them.
      in_program: of the same, as in `gym_ids.from_gymnasium`.

    Raises:
      ValueError: as `envs.make`.
    """
    options: dict[str, Any] = {}
    if envs.takes_arguments(config.env):
        options = {"arguments": env_args.parse(config.env_args), "max_episode_steps": config.max_episode_steps}
    if physics in gym_ids.PHYSICS:
        options |= {"processes": processes, "in_program": in_program}
    return envs.make(config.env, physics, **options)


def agent_of(config: Config, env: Environment) -> Agent:
    """The agent of an experiment, for an environment's sizes."""
    return make_parts(config.algo, config.agent, env.observation_size, env.action_size).agent


def replay_of(config: Config, env: Environment) -> Replay:
    """The replay buffer of an experiment, for an environment's sizes."""
    agent, settings = config.agent, config.train
    rows = Ring(
        capacity=settings.capacity,
        observation_size=env.observation_size,
        action_size=env.action_size,
        num_envs=settings.num_envs,
        min_mean_episode_length=env.min_mean_episode_length,
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
    if training_env.host:
        eval_env = training_env.host.separate()
    elif env is not None or physics == config.physics:
        eval_env = training_env
    else:
        eval_env = named_env(config, physics)
    buffer = replay_of(config, training_env)
    return train.make_trainer(agent_of(config, training_env), training_env, buffer, config.train, eval_env)


def make_train(config: Config, env: Environment | None = None) -> Callable[..., tuple[train.TrainState, train.History]]:
    """One member's complete run: `train(key, scalars=None) -> (state, history)`.

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
