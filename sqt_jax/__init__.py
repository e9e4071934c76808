"""SQT, a conservative target for ensemble actor-critics, on TD3, SAC and TD7: pure JAX functions (guide: README.md)."""

from sqt_jax import q_targets
from sqt_jax.algorithms import ALGORITHMS, make_agent
from sqt_jax.config import Config
from sqt_jax.envs import make as make_env
from sqt_jax.envs.autoreset import make_environment
from sqt_jax.evaluate import evaluate_policy
from sqt_jax.experiment import make_config, make_train, make_trainer
from sqt_jax.policy import load_policy, save_policy
from sqt_jax.settings import ConfigError
from sqt_jax.train import make_sweep
from sqt_jax.types import Agent, Environment, Replay, Scalars, TimeStep, Transition

__all__ = [
    "ALGORITHMS",
    "Agent",
    "Config",
    "ConfigError",
    "Environment",
    "Replay",
    "Scalars",
    "TimeStep",
    "Transition",
    "evaluate_policy",
    "load_policy",
    "make_agent",
    "make_config",
    "make_env",
    "make_environment",
    "make_sweep",
    "make_train",
    "make_trainer",
    "q_targets",
    "save_policy",
]
