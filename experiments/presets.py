"""Named bundles of settings: `--preset=NAME`. A flag given on the command line wins over its preset."""

from fnmatch import fnmatchcase
from typing import Any, NamedTuple


class Row(NamedTuple):
    """Settings for the algorithms and environments whose names match (`*` matches everything)."""

    settings: dict[str, Any]
    algo: str = "*"
    env: str = "*"


# Later rows win over earlier ones.
PRESETS: dict[str, tuple[Row, ...]] = {
    # The paper's protocol is what the settings' own defaults say.
    "paper": (),
    # A few minutes on two cores: enough to see a run work from end to end, not to judge an algorithm.
    "quick": (
        Row(
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
}


def preset_settings(preset: str, algo: str, env: str) -> dict[str, Any]:
    """The settings of a preset for one algorithm and environment (by their own names, not aliases)."""
    merged: dict[str, Any] = {}
    for row in PRESETS[preset]:
        if fnmatchcase(algo, row.algo) and fnmatchcase(env, row.env):
            merged |= row.settings
    return merged
