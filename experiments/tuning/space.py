"""The settings that are tuned and the ranges of their values: `--space=penalty_coef=0..1,lr=log:1e-4..1e-3`.

    NAME=LOW..HIGH        uniform
    NAME=log:LOW..HIGH    uniform in the logarithm
    NAME=LOW..HIGH:STEP   LOW, LOW + STEP, ..., HIGH
    NAME=A|B|C            these values

Both ends belong to a range. Only swept settings can be tuned (`config.SETTINGS`): their values are traced, so that all
trials of a batch are one compiled program.
"""

import math
from collections.abc import Collection, Sequence
from decimal import Decimal
from typing import NamedTuple

from experiments.commandline.arguments import UsageError
from sqt_jax.algorithms import ALGORITHMS, default_agent_config, features_of
from sqt_jax.config import SETTINGS
from sqt_jax.settings import ConfigError
from sqt_jax.suggestions import expects_one_of

FORMS = "NAME=LOW..HIGH, NAME=log:LOW..HIGH, NAME=LOW..HIGH:STEP or NAME=A|B|C"
MAX_VALUES = 10_000  # of an axis with a step


class Axis(NamedTuple):
    """A setting that is tuned."""

    name: str
    low: float
    high: float
    log: bool = False
    step: float | None = None
    choices: tuple[float, ...] = ()  # these values only, in this order; `low` and `high` are their ends

    def __str__(self) -> str:
        """The text that it is parsed from."""
        if self.choices:
            return f"{self.name}={'|'.join(map(_text, self.choices))}"
        ending = "" if self.step is None else f":{_text(self.step)}"
        return f"{self.name}={'log:' if self.log else ''}{_text(self.low)}..{_text(self.high)}{ending}"

    @property
    def values(self) -> tuple[float, ...]:
        """All values, if there is a finite number of them; else empty."""
        if self.choices or self.step is None:
            return self.choices
        # as decimals: 3 * 0.1 is 0.3
        low, step = Decimal(str(self.low)), Decimal(str(self.step))
        return tuple(float(low + index * step) for index in range(round((self.high - self.low) / self.step) + 1))


def parse_space(text: str, algo: str) -> tuple[Axis, ...]:
    """The axes of `--space=text`.

    Args:
      algo: a name of `ALGORITHMS`, which has to have the settings.

    Raises:
      UsageError: the text has another form, or a setting cannot be tuned or cannot have these values.
    """
    axes: dict[str, Axis] = {}
    for part in text.split(","):
        name, equals, values = (word.strip() for word in part.partition("="))
        if not equals or not name:
            raise UsageError(f"--space: expects {FORMS}, separated by commas, not {part.strip()!r}")
        if name in axes:
            raise UsageError(f"--space: expects {name} once")
        _check_name(name, algo)
        axes[name] = _parse_axis(name, values)
    return tuple(axes.values())


def axes_of(algo: str, axes: Sequence[Axis]) -> tuple[Axis, ...]:
    """Those of the axes that an algorithm has: a baseline has no `penalty_coef`."""
    return tuple(axis for axis in axes if _has(algo, axis.name))


def grid_size(axes: Sequence[Axis]) -> int | None:
    """The number of combinations; None if a range has no step."""
    return math.prod(len(axis.values) for axis in axes) if all(axis.values for axis in axes) else None


def check_no_flags(axes: Sequence[Axis], given: Collection[str]) -> None:
    """Raises `UsageError` if a tuned setting is also given as a flag of every run."""
    for axis in axes:
        if axis.name in given or SETTINGS[axis.name].auto in given:
            raise UsageError(f"--{axis.name}: has no effect where --space tunes it")


def _check_name(name: str, algo: str) -> None:
    swept = [setting for setting, about in SETTINGS.items() if about.swept]
    if name not in swept:
        raise UsageError(f"--space: {expects_one_of(name, swept)}: settings that are values, not sizes")
    if not _has(algo, name):
        raise UsageError(f"--space: {name} has no effect with {algo}")


def _has(algo: str, name: str) -> bool:
    return set(SETTINGS[name].features) <= features_of(ALGORITHMS[algo], default_agent_config(algo))


def _parse_axis(name: str, text: str) -> Axis:
    log = text.startswith("log:")
    ends, colon, step_text = text.removeprefix("log:").partition(":")
    low_text, dots, high_text = ends.partition("..")
    if not dots:
        return _parse_choices(name, text)
    low, high = _number(name, low_text), _number(name, high_text)
    step = _number(name, step_text) if colon else None
    for value in (low, high):
        _check(name, value)
    if not low < high:
        raise UsageError(f"--space: {name} expects LOW below HIGH, not {ends}")
    if log and (step is not None or low <= 0):
        raise UsageError(f"--space: {name} expects log:LOW..HIGH with LOW above 0 and no STEP, not {text}")
    if step is not None:
        count = (high - low) / step if step > 0 else math.inf
        if count > MAX_VALUES or count < 0.5 or abs(count - round(count)) > 1e-6:
            raise UsageError(
                f"--space: {name} expects whole STEPs from LOW to HIGH, at most {MAX_VALUES:,}, not {text}"
            )
    return Axis(name, low, high, log, step)


def _parse_choices(name: str, text: str) -> Axis:
    choices = tuple(_number(name, word) for word in text.split("|"))
    if len(choices) < 2 or len(set(choices)) < len(choices):
        raise UsageError(f"--space: {name} expects {FORMS}, each value once, not {text!r}")
    for value in choices:
        _check(name, value)
    return Axis(name, min(choices), max(choices), choices=choices)


def _number(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"--space: {name} expects numbers as in {FORMS}, not {text!r}")
    return value


def _text(value: float) -> str:
    """`0.1`, `1`"""
    return repr(value).removesuffix(".0")


def _check(name: str, value: float) -> None:
    try:
        SETTINGS[name].check(value)
    except ConfigError as error:
        raise UsageError(f"--space: {name} {error.message}") from None
