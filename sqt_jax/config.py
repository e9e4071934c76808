"""Every setting: a field with its default (the paper's protocol), limits, help text and the feature that uses it.

A setting is checked here once, for the library and the command line alike, before anything is compiled.
"""

import dataclasses
from typing import Any

from sqt_jax import q_targets
from sqt_jax.settings import ConfigError, Setting, setting, settings_of
from sqt_jax.types import Scalars

# Properties that an algorithm may have (its row names them) and that settings may require.
FEATURES = {
    "penalty": "a penalty (_sqt, _sqt_tuple)",
    "subset": "a random subset of the critics (redq, --reduce=subset_min)",
    "soft_targets": "soft target updates (td3, sac, maxmin, redq)",
    "noise": "noise on deterministic actions (td3, td7, maxmin)",
    "entropy": "an entropy term (sac, redq)",
    "mlp": "MLP networks (td3, sac, maxmin, redq)",
    "sale": "SALE networks (td7, --networks=sale)",
    "checkpoints": "prioritised replay and policy checkpoints (td7)",
}


@dataclasses.dataclass(frozen=True)
class AgentConfig:
    """The settings of an agent: sizes and choices (static), and the values of the traced `Scalars`."""

    # The target (SQT paper, eqs. 4, 8, 18-20).
    penalty: str = setting(
        "none", "the term subtracted from the bootstrapped value", choices=tuple(q_targets.PENALTIES), flag=None
    )
    penalty_coef: float = setting(
        0.0, "weight of the penalty, the paper's alpha", low=0, swept=True, features=("penalty",)
    )
    ddof: int = setting(1, "the std over critics divides by N - ddof", low=0)
    penalty_inside_gamma: bool = setting(
        True, "discount and mask the penalty with the bootstrapped value", features=("penalty",)
    )
    reduce: str = setting("min", "how the target critics' values become one", choices=tuple(q_targets.REDUCTIONS))
    subset_size: int = setting(2, "critics drawn per update by --reduce=subset_min", low=1, features=("subset",))
    # Networks.
    ensemble_size: int = setting(2, "number of critics", low=1, high=1000)
    hidden: tuple[int, ...] = setting((256, 256), "widths of the hidden layers")
    layer_norm: bool = setting(False, "normalise the critics' hidden layers before their ReLU", features=("mlp",))
    normalize_observations: bool = setting(
        False, "normalise observations by the mean and std of those seen so far, clipped to +-10"
    )
    # Optimisation.
    lr: float = setting(3e-4, "Adam's learning rate", low=0, high=1, swept=True)
    gamma: float = setting(0.99, "discount factor", low=0, high=1, swept=True)
    tau: float = setting(
        0.005, "step of the soft target updates", low=0, high=1, swept=True, features=("soft_targets",)
    )
    policy_delay: int = setting(1, "critic updates per actor update", low=1)
    actor_reduce: str = setting(
        "mean", "the reduction of the critics that the actor maximises", choices=tuple(q_targets.ACTOR_REDUCTIONS)
    )
    # TD3's noise, in units of the action.
    exploration_noise: float = setting(0.1, "std of the noise on actions", low=0, features=("noise",))
    target_noise: float = setting(0.2, "std of the noise on target actions", low=0, features=("noise",))
    target_noise_clip: float = setting(0.5, "limit of the noise on target actions", low=0, features=("noise",))
    # SAC's entropy.
    temperature: float = setting(
        0.2, "weight of the entropy; auto learns it, starting at 0.2", low=0, swept=True, features=("entropy",),
        auto="learn_temperature",
    )  # fmt: skip
    learn_temperature: bool = setting(False, "learn the temperature", features=("entropy",), flag="temperature")
    # SALE networks.
    embedding_size: int = setting(256, "size Z of the embeddings zs and zsa", low=1, high=65536, features=("sale",))
    target_update_period: int = setting(250, "updates between hard target copies", low=1, features=("sale",))
    min_priority: float = setting(
        1.0, "where the critics' Huber loss becomes linear, and LAP's smallest priority", low=1e-6, features=("sale",)
    )
    # TD7's replay and policy checkpoints (its authors' names in brackets).
    priority_exponent: float = setting(0.4, "LAP's exponent (alpha)", low=0, high=1, features=("checkpoints",))
    policy_checkpoint_switch: int = setting(
        750_000, "updates until a policy is assessed on --assessment_episodes, not one (steps_before_checkpointing)",
        low=0, features=("checkpoints",), formerly="checkpoint_switch",
    )  # fmt: skip
    assessment_episodes: int = setting(
        20, "episodes per assessment after the switch (max_eps_when_checkpointing)", low=1, features=("checkpoints",)
    )
    policy_checkpoint_reset_weight: float = setting(
        0.9, "factor on the best minimum return at the switch; a negative one gets harder to reach (reset_weight)",
        low=0, high=1, features=("checkpoints",), formerly="checkpoint_reset_weight",
    )  # fmt: skip
    # The released code's variants of TD3, SAC and TD7 (`agents.released`).
    networks: str = setting("mlp", "mlp, or TD7's networks and update without its checkpoints", choices=("mlp", "sale"))
    sampled_actor: bool = setting(
        False, "a Gaussian actor that is updated by its samples; its mode acts", features=("sale", "noise")
    )
    squashed_log_prob: bool = setting(
        True, "log-probabilities of the action, summed; else the Gaussian's, averaged", features=("sale", "entropy")
    )
    train_encoder: bool = setting(True, "train the encoder of the embeddings", features=("sale",))
    value_clipping: bool = setting(
        True, "clip the bootstrapped value to the range of the targets seen so far", features=("sale",)
    )

    def scalars(self) -> Scalars:
        """The traced settings."""
        return Scalars(**{name: getattr(self, name) for name in Scalars._fields})


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """How an agent is trained. Steps are environment steps (transitions) of one member."""

    steps: int = setting(1_000_000, "environment steps per member", low=1, high=2**31 - 1)
    warmup_steps: int = setting(25_000, "first steps, with uniform random actions and no updates", low=0)
    batch_size: int = setting(256, "transitions per update", low=1)
    replay_capacity: int = setting(1_000_000, "transitions kept per member", low=1, high=2**31 - 1)
    num_envs: int = setting(1, "environments in lockstep per member", low=1)
    updates_per_step: int = setting(1, "updates per transition", low=1)
    eval_every: int = setting(5_000, "environment steps between evaluations", low=1)
    eval_episodes: int = setting(10, "episodes per evaluation", low=1)

    @property
    def capacity(self) -> int:
        """Rows of the replay: no more than the run can fill, and a multiple of `num_envs`."""
        return min(self.replay_capacity, self.steps) // self.num_envs * self.num_envs


# The fields of `Config` that say what is trained on.
ENVIRONMENT = ("env", "physics", "eval_physics", "env_args", "max_episode_steps")


@dataclasses.dataclass(frozen=True)
class Config:
    """One member's experiment without its seed. `sqt_jax.make_config` makes and checks it."""

    algo: str
    env: str
    physics: str = setting(
        "mjx", "the physics: mjx, mujoco or warp; not mujoco for playground:NAME; brax:NAME has others"
    )
    eval_physics: str = setting("auto", "the same for evaluation; auto: mujoco on a CPU, else the training's")
    env_args: str = setting(
        "",
        "keyword arguments of the environment, NAME=VALUE,... (gym:ID, playground:NAME, MODULE:FUNCTION)",
        default_text="none",
    )
    max_episode_steps: int = setting(
        0, "time limit of its episodes (gym:ID, playground:NAME, MODULE:FUNCTION); 0: the environment's own", low=0
    )
    agent: AgentConfig = AgentConfig()
    train: TrainConfig = TrainConfig()

    def flat(self) -> dict[str, Any]:
        """All settings by name, without nesting: as in config.json and for `make_config`."""
        own = {"algo": self.algo} | {name: getattr(self, name) for name in ENVIRONMENT}
        return own | dataclasses.asdict(self.agent) | dataclasses.asdict(self.train)


SETTINGS: dict[str, Setting] = settings_of(Config) | settings_of(AgentConfig) | settings_of(TrainConfig)

_swept = {name for name, about in SETTINGS.items() if about.swept}
if _swept != {*Scalars._fields}:
    raise TypeError(f"swept settings and the fields of types.Scalars differ: {_swept ^ {*Scalars._fields}}")


def _reject(wrong: bool, name: str, message: str) -> None:
    if wrong:
        raise ConfigError(name, message)


def check_agent(algo: str, agent: AgentConfig) -> None:
    """Raises ConfigError if an agent's settings are invalid, each or together."""
    for name, about in settings_of(AgentConfig).items():
        about.check(getattr(agent, name))
    n = agent.ensemble_size
    if agent.penalty != "none":
        _reject(n < 2, "ensemble_size", f"expects at least 2 for {algo}: one critic has no disagreement")
    # Also without a penalty: the disagreement is reported, unless there is only one critic.
    _reject(n > 1 and agent.ddof >= n, "ddof", f"expects a number below the ensemble_size ({n}), not {agent.ddof}")
    if agent.reduce == "subset_min":
        message = f"expects at most the ensemble_size ({n}), not {agent.subset_size}"
        _reject(agent.subset_size > n, "subset_size", message)
    if agent.learn_temperature:
        _reject(agent.temperature <= 0, "temperature", "expects a positive start where it is learned")
        _reject(agent.networks == "sale", "temperature", "expects a number with --networks=sale, not auto")


def check_train(train: TrainConfig) -> None:
    """Raises ConfigError if the settings of a training run are invalid, each or together."""
    for name, about in settings_of(TrainConfig).items():
        about.check(getattr(train, name))
    _reject(
        train.warmup_steps >= train.steps,
        "warmup_steps",
        f"expects fewer than the run's steps ({train.steps}), not {train.warmup_steps}: nothing would be learned",
    )
    _reject(train.capacity < 1, "replay_capacity", f"expects at least num_envs ({train.num_envs})")
    _reject(
        train.batch_size > train.capacity,
        "batch_size",
        f"expects at most the replay's capacity ({train.capacity}), not {train.batch_size}",
    )
    for name in ("steps", "warmup_steps", "eval_every"):
        value = getattr(train, name)
        message = f"expects a multiple of num_envs ({train.num_envs}), not {value}"
        _reject(value % train.num_envs != 0, name, message)
