"""The command line of `experiments.tune`, checked as far as that needs neither JAX's devices nor a file."""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.commandline import flags
from experiments.commandline.arguments import UsageError
from experiments.evidence.variants import baseline_of
from experiments.grids.grid import check_run_flags
from experiments.grids.own_grid import CELL_FLAGS
from experiments.tuning.space import Axis, axes_of, check_no_flags, grid_size, parse_space
from sqt_jax import envs
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.config import SETTINGS
from sqt_jax.envs.factories import is_factory
from sqt_jax.suggestions import expects_one_of

SAMPLERS = ("tpe", "random", "grid")
OBJECTIVES = ("score", "final")
EXAMPLE = "--algo=td3_sqt --env=cheetah --space=penalty_coef=0..1"
# Flags of experiments.run that the command sets itself, in addition to those of a grid's cells.
OWN_FLAGS = (*CELL_FLAGS, "seeds", "paired", "tuned")


class Given(NamedTuple):
    """The command's own flags as they were given; None: not given."""

    algo: str | None
    env: str | None
    space: str | None
    trials: int
    batch: int
    seeds: Sequence[str]
    sampler: str
    sampler_seed: int
    objective: str
    final_seeds: int
    out: str


class Options(NamedTuple):
    """A checked command line."""

    algo: str
    env: str
    axes: tuple[Axis, ...]
    trials: int
    batch: int
    seeds: tuple[int, ...]
    sampler: str
    sampler_seed: int
    objective: str
    final_seeds: int
    out: Path
    run_flags: tuple[str, ...]  # of every run

    @property
    def baseline(self) -> str | None:
        """The algorithm that the tuned one is compared with."""
        name = baseline_of(self.algo)
        return None if name == self.algo else name

    def flags_of(self, algo: str) -> tuple[str, ...]:
        """The flags of an algorithm's runs: those of the penalty are not a baseline's."""
        if algo == self.algo:
            return self.run_flags
        return tuple(word for word in self.run_flags if "penalty" not in _features(word))

    def axes_of(self, algo: str) -> tuple[Axis, ...]:
        """What is tuned of an algorithm."""
        return axes_of(algo, self.axes)

    def settings_of(self, algo: str) -> dict[str, Any]:
        """What the trials of an algorithm's study depend on, as values that JSON has."""
        parsed = _parse(algo, self.env, self.flags_of(algo))
        settings = {name: list(v) if isinstance(v, tuple) else v for name, v in parsed.settings.items()}
        return {
            "algo": algo,
            "env": self.env,
            "space": ",".join(map(str, self.axes_of(algo))),
            "batch": self.batch,
            "seeds": list(self.seeds),
            "sampler": self.sampler,
            "sampler_seed": self.sampler_seed,
            "objective": self.objective,
            "preset": parsed.preset,
            "settings": settings,
        }


def check_flags(given: Given, run_flags: Sequence[str]) -> Options:
    """The command line as `Options`.

    Args:
      run_flags: the words that are none of the command's own flags.

    Raises:
      UsageError: a flag is missing or invalid, or Optuna is not installed.
    """
    for name in ("algo", "env", "space"):
        if not getattr(given, name):
            raise UsageError(f"--{name}: is required, as in python -m experiments.tune {EXAMPLE}")
    assert given.algo and given.env and given.space
    if given.algo not in ALGORITHMS:
        raise UsageError(f"--algo: {expects_one_of(given.algo, ALGORITHMS)}")
    try:
        env = given.env if is_factory(given.env) else envs.resolve(given.env)
    except ValueError as error:
        raise UsageError(f"--env: {error}") from None
    for name, value, choices in (("sampler", given.sampler, SAMPLERS), ("objective", given.objective, OBJECTIVES)):
        if value not in choices:
            raise UsageError(f"--{name}: {expects_one_of(value, choices)}")
    check_run_flags(run_flags, OWN_FLAGS)
    axes = parse_space(given.space, given.algo)
    if given.sampler == "grid" and grid_size(axes) is None:
        name = next(axis.name for axis in axes if not axis.values)
        raise UsageError(f"--space: {name} expects a STEP or values with --sampler=grid, as in {name}=0..1:0.1")
    parsed = _parse(given.algo, env, [*run_flags, f"--seeds={','.join(given.seeds)}"])
    if parsed.sweep or parsed.paired:
        name = next(iter(parsed.sweep), "paired")
        raise UsageError(f"--{name}: expects one value: the members of a run are the trials of a batch")
    check_no_flags(axes, parsed.settings)
    assert parsed.seeds
    if given.batch * len(parsed.seeds) > flags.MAX_MEMBERS:
        raise UsageError(f"--batch={given.batch}: expects at most {flags.MAX_MEMBERS} members, trials times seeds")
    options = Options(
        algo=given.algo,
        env=env,
        axes=axes,
        trials=given.trials,
        batch=given.batch,
        seeds=parsed.seeds,
        sampler=given.sampler,
        sampler_seed=given.sampler_seed,
        objective=given.objective,
        final_seeds=given.final_seeds,
        out=Path(given.out),
        run_flags=tuple(run_flags),
    )
    if options.baseline:
        _parse(options.baseline, env, options.flags_of(options.baseline))
    if importlib.util.find_spec("optuna") is None:
        raise UsageError(f"--sampler={given.sampler}: expects the package optuna; pip install 'sqt_jax[tune]'")
    return options


def _parse(algo: str, env: str, words: Sequence[str]) -> flags.Options:
    parsed = flags.parse(["run", f"--algo={algo}", f"--env={env}", *words])
    if parsed is None:
        raise UsageError("--help: expects no other flags")
    return parsed


def _features(word: str) -> tuple[str, ...]:
    """The features of the setting that a flag like `--nopenalty_inside_gamma` sets."""
    name = word.lstrip("-").partition("=")[0]
    about = SETTINGS.get(name) or SETTINGS.get(name.removeprefix("no"))
    return about.features if about else ()
