"""Every setting, its default and its limits (defaults: the paper's protocol).

A setting is checked here once, for the library and the command line alike, before anything is compiled.
"""

import dataclasses
import math
from typing import Any

from sqt_jax.types import Scalars


class ConfigError(ValueError):
    """A setting that cannot be. `setting` is its name (the command line's flag without the dashes)."""

    def __init__(self, setting: str, message: str):
        super().__init__(setting, message)  # both, so that it can be pickled: a pool of processes passes errors so
        self.setting, self.message = setting, message

    def __str__(self) -> str:
        return f"--{self.setting}: {self.message}"


@dataclasses.dataclass(frozen=True)
class AgentConfig:
    """What an agent is made of: sizes and choices (static), and the start values of the traced `Scalars`."""

    # The target (paper eqs. 4, 8, 18-20).
    penalty: str = "none"  # none | batch_std (SQT, eq. 20) | transition_std (SQT-tuple, eq. 19)
    penalty_coef: float = 0.0  # the paper's alpha
    ddof: int = 1  # of the std over critics; 1 is torch's default, which the authors' released code uses
    penalty_inside_gamma: bool = True
    reduce: str = "min"  # min | mean | subset_min (REDQ)
    subset_size: int = 2  # critics drawn per update by subset_min
    # Networks.
    ensemble_size: int = 2  # N
    hidden: tuple[int, ...] = (256, 256)
    # mlp | sale: TD7's, with its critic loss, value bounds and hard target copies; SAC's next action is then the target
    # actor's.
    networks: str = "mlp"
    # Optimisation.
    lr: float = 3e-4
    gamma: float = 0.99
    tau: float = 0.005
    policy_delay: int = 1  # critic updates per actor update
    actor_reduce: str = "mean"  # mean | min | first: what the actor maximises of the N critics
    # TD3's noises, in units of the action.
    exploration_noise: float = 0.1
    target_noise: float = 0.2
    target_noise_clip: float = 0.5
    sampled_actor: bool = False  # a Gaussian actor whose samples its update uses: the authors' released code
    # SAC's entropy.
    temperature: float = 0.2
    learn_temperature: bool = False
    squashed_log_prob: bool = True  # of the action; else of the Gaussian, averaged over dims: the released code
    # With SALE networks.
    embedding_size: int = 256  # Z of zs and zsa
    train_encoder: bool = True
    value_clipping: bool = True  # the reduced value stays within the targets seen so far
    target_update_period: int = 250  # updates between hard copies
    min_priority: float = 1.0  # where the critics' Huber loss becomes linear, and the smallest |TD error| of LAP
    # TD7's replay and policy checkpoints.
    priority_exponent: float = 0.4
    checkpoint_switch: int = 750_000  # gradient steps after which an assessment expects `assessment_episodes`
    assessment_episodes: int = 20
    checkpoint_reset_weight: float = 0.9  # what the best minimum return is multiplied with at the switch

    def scalars(self) -> Scalars:
        return Scalars(**{name: getattr(self, name) for name in Scalars._fields})


# The settings that SALE networks have, and those that TD7 has besides.
SALE_SETTINGS = ("embedding_size", "train_encoder", "value_clipping", "target_update_period", "min_priority")
TD7_SETTINGS = ("priority_exponent", "checkpoint_switch", "assessment_episodes", "checkpoint_reset_weight")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """How an agent is trained. Steps are environment steps (transitions) of one member."""

    steps: int = 1_000_000
    warmup_steps: int = 25_000  # uniform random actions, no updates
    batch_size: int = 256
    replay_capacity: int = 1_000_000
    num_envs: int = 1  # E: environments in lockstep per member
    updates_per_step: int = 1  # UTD: updates per transition
    eval_every: int = 5_000
    eval_episodes: int = 10

    @property
    def capacity(self) -> int:
        """Rows of the replay: no more than the run can fill, and a multiple of `num_envs`."""
        return min(self.replay_capacity, self.steps) // self.num_envs * self.num_envs


@dataclasses.dataclass(frozen=True)
class Config:
    """One member's whole experiment, but for its seed. Made and checked by `sqt_jax.make_config`."""

    algo: str
    env: str
    physics: str
    eval_physics: str  # auto: MuJoCo C where the program runs on a CPU, else the training's
    agent: AgentConfig
    train: TrainConfig

    def flat(self) -> dict[str, Any]:
        """All settings by name, without nesting: what `config.json` holds and `make_config` expects back."""
        own = {"algo": self.algo, "env": self.env, "physics": self.physics, "eval_physics": self.eval_physics}
        return own | dataclasses.asdict(self.agent) | dataclasses.asdict(self.train)


CHOICES = {
    "penalty": ("none", "batch_std", "transition_std"),
    "reduce": ("min", "mean", "subset_min"),
    "actor_reduce": ("mean", "min", "first"),
    "networks": ("mlp", "sale"),
}

SWITCHES = (
    "penalty_inside_gamma",
    "sampled_actor",
    "learn_temperature",
    "squashed_log_prob",
    "train_encoder",
    "value_clipping",
)

# Limits of numbers, as (lowest, highest, what the setting expects).
LIMITS: dict[str, tuple[float, float, str]] = {
    "penalty_coef": (0, math.inf, "a number of at least 0"),
    "ddof": (0, math.inf, "a whole number of at least 0"),
    "subset_size": (1, math.inf, "a whole number of at least 1"),
    "ensemble_size": (1, 1000, "a whole number from 1 to 1000"),
    "lr": (0, 1, "a number from 0 to 1"),
    "gamma": (0, 1, "a number from 0 to 1"),
    "tau": (0, 1, "a number from 0 to 1"),
    "policy_delay": (1, math.inf, "a whole number of at least 1"),
    "exploration_noise": (0, math.inf, "a number of at least 0"),
    "target_noise": (0, math.inf, "a number of at least 0"),
    "target_noise_clip": (0, math.inf, "a number of at least 0"),
    "temperature": (0, math.inf, "a number of at least 0"),
    "embedding_size": (1, 65536, "a whole number from 1 to 65536"),
    "target_update_period": (1, math.inf, "a whole number of at least 1"),
    "priority_exponent": (0, 1, "a number from 0 to 1"),
    "min_priority": (1e-6, math.inf, "a number of at least 0.000001"),
    "checkpoint_switch": (0, math.inf, "a whole number of at least 0"),
    "assessment_episodes": (1, math.inf, "a whole number of at least 1"),
    "checkpoint_reset_weight": (0, 1, "a number from 0 to 1"),
    "steps": (1, 2**31 - 1, "a whole number from 1 to 2147483647"),
    "warmup_steps": (0, math.inf, "a whole number of at least 0"),
    "batch_size": (1, math.inf, "a whole number of at least 1"),
    "replay_capacity": (1, 2**31 - 1, "a whole number from 1 to 2147483647"),
    "num_envs": (1, math.inf, "a whole number of at least 1"),
    "updates_per_step": (1, math.inf, "a whole number of at least 1"),
    "eval_every": (1, math.inf, "a whole number of at least 1"),
    "eval_episodes": (1, math.inf, "a whole number of at least 1"),
}


# What the device holds: int32, float32.
LARGEST_INTEGER, LARGEST_NUMBER = 2**31 - 1, 3.4e38
MAX_LAYERS = 32


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 100 else f"{text[:100]}..."


def check_value(setting: str, value: Any) -> None:
    """Raises ConfigError where `value` alone, whatever the other settings are, cannot be."""
    if setting in CHOICES and value not in CHOICES[setting]:
        raise ConfigError(setting, f"expects one of {', '.join(CHOICES[setting])}, not {value!r}")
    if setting in LIMITS:
        low, high, expects = LIMITS[setting]
        kinds, largest = ((int,), LARGEST_INTEGER) if "whole" in expects else ((int, float), LARGEST_NUMBER)
        if isinstance(value, bool) or not isinstance(value, kinds) or not low <= value <= min(high, largest):
            if isinstance(value, kinds) and value > largest and high == math.inf:
                expects = f"{expects} and at most {largest}"
            raise ConfigError(setting, f"expects {expects}, not {value!r}")
    if setting in SWITCHES and not isinstance(value, bool):
        raise ConfigError(setting, f"expects true or false, not {value!r}")
    if setting == "hidden" and not (
        isinstance(value, (tuple, list))
        and 1 <= len(value) <= MAX_LAYERS
        and all(type(w) is int and 1 <= w <= 65536 for w in value)
    ):
        expects = f"layer widths, up to {MAX_LAYERS} whole numbers from 1 to 65536 as in 256,256"
        raise ConfigError(setting, f"expects {expects}, not {_brief(value)}")


def _refuse(wrong: bool, setting: str, message: str) -> None:
    if wrong:
        raise ConfigError(setting, message)


def check_agent(algo: str, agent: AgentConfig) -> None:
    """Raises ConfigError where an agent's settings cannot be, alone or together."""
    for name, value in dataclasses.asdict(agent).items():
        check_value(name, value)
    n = agent.ensemble_size
    if agent.penalty == "none":
        message = f"expects 0 for {algo}, which has no penalty (its _sqt and _sqt_tuple forms have one)"
        _refuse(agent.penalty_coef > 0, "penalty_coef", message)
        _refuse(not agent.penalty_inside_gamma, "penalty_inside_gamma", f"has no effect with {algo}")
    else:
        _refuse(n < 2, "ensemble_size", f"expects at least 2 for {algo}: one critic alone has no disagreement")
    # Without a penalty too: the disagreement is reported, unless there is one critic alone.
    _refuse(n > 1 and agent.ddof >= n, "ddof", f"expects a number below the ensemble_size ({n}), not {agent.ddof}")
    if agent.reduce == "subset_min":
        _refuse(
            agent.subset_size > n, "subset_size", f"expects at most the ensemble_size ({n}), not {agent.subset_size}"
        )
    else:
        differs = agent.subset_size != AgentConfig.subset_size
        _refuse(differs, "subset_size", f"has no effect with --reduce={agent.reduce}")
    if agent.learn_temperature:
        _refuse(agent.temperature <= 0, "temperature", "expects a positive start where it is learned")
        _refuse(agent.networks == "sale", "temperature", "expects a number with --networks=sale, not auto")
        # The target entropy is that of the action, summed over its dimensions.
        message = "expects true where the temperature is learned"
        _refuse(not agent.squashed_log_prob, "squashed_log_prob", message)


def check_train(train: TrainConfig) -> None:
    """Raises ConfigError where the settings of a training run cannot be, alone or together."""
    for name, value in dataclasses.asdict(train).items():
        check_value(name, value)
    _refuse(
        train.warmup_steps >= train.steps,
        "warmup_steps",
        f"expects fewer than the run's steps ({train.steps}), not {train.warmup_steps}: nothing would be learned",
    )
    _refuse(train.capacity < 1, "replay_capacity", f"expects at least num_envs ({train.num_envs})")
    _refuse(
        train.batch_size > train.capacity,
        "batch_size",
        f"expects at most the replay's capacity ({train.capacity}), not {train.batch_size}",
    )
    for name in ("steps", "warmup_steps", "eval_every"):
        value = getattr(train, name)
        message = f"expects a multiple of num_envs ({train.num_envs}), not {value}"
        _refuse(value % train.num_envs != 0, name, message)
