"""Named bundles of settings: `--preset=NAME`. A flag given on the command line wins over its preset."""

import functools
import operator
from typing import Any, NamedTuple

from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.settings import ConfigError


class PresetRow(NamedTuple):
    """Settings for some algorithms."""

    settings: dict[str, Any]
    baselines: tuple[str, ...] = ()  # for these and their SQT variants; empty: for all algorithms
    penalty: bool = False  # for those with a penalty only


# The authors' released code trains TD7's update with TD3's or SAC's actions, under the names of TD3 and SAC, with an
# encoder that is never trained.
UNTRAINED_SALE = {"networks": "sale", "train_encoder": False, "value_clipping": False}

# Later rows win over earlier ones.
PRESETS: dict[str, tuple[PresetRow, ...]] = {
    # The defaults of the settings are the paper's protocol.
    "paper": (),
    # A few minutes on two cores: enough to see a run work from end to end, not to judge an algorithm.
    "quick": (
        PresetRow(
            {
                "steps": 6_000,
                "warmup_steps": 1_000,
                "eval_every": 1_000,
                "eval_episodes": 1,
                "batch_size": 128,
                "replay_capacity": 6_000,
            }
        ),
    ),
    # The authors' released code (BUILD_NOTES.md, "What is trained, in full").
    "released": (
        PresetRow(UNTRAINED_SALE | {"sampled_actor": True}, ("td3",)),
        PresetRow(UNTRAINED_SALE | {"policy_delay": 2, "squashed_log_prob": False}, ("sac",)),
        PresetRow({"sampled_actor": True, "updates_per_step": 2}, ("td7",)),
        PresetRow({"penalty_coef": 1.0}, ("td3", "sac", "td7"), penalty=True),
    ),
}


def preset_settings(preset: str, algo: str, env: str) -> dict[str, Any]:
    """The settings of a preset for one algorithm; `env` is for the message only.

    Raises:
      ConfigError: the preset says nothing of this algorithm.
    """
    row = ALGORITHMS[algo]
    has_penalty = row.settings.get("penalty", "none") != "none"
    found = [
        each.settings
        for each in PRESETS[preset]
        if (not each.baselines or (row.baseline or algo) in each.baselines) and (has_penalty or not each.penalty)
    ]
    if PRESETS[preset] and not found:
        raise ConfigError("preset", f"{preset} has no settings for {algo} on {env}")
    return functools.reduce(operator.or_, found, {})
