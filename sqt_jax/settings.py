"""How a setting is declared: one dataclass field that says everything about it.

    gamma: float = setting(0.99, "discount factor", low=0, high=1, swept=True)

The command line's flags, `--help`, YAML files, config.json, limits and "has no effect with ..." all read these fields.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, get_type_hints

# The device holds int32 and float32.
LARGEST_INTEGER, LARGEST_NUMBER = 2**31 - 1, 3.4e38
MAX_LAYERS, MAX_WIDTH = 32, 65536
_KEY = "setting"


class ConfigError(ValueError):
    """An invalid setting. `setting` is its name (the command line's flag without the dashes)."""

    def __init__(self, setting: str, message: str):
        super().__init__(setting, message)  # both, so that it can be pickled and passed between processes
        self.setting, self.message = setting, message

    def __str__(self) -> str:
        return f"--{self.setting}: {self.message}"


class Setting(NamedTuple):
    """One setting. Its type is the annotation of its field."""

    name: str
    type: Any  # int, float, bool, str or tuple[int, ...]
    default: Any
    help: str
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    swept: bool = False  # traced: a list of values is a sweep (`types.Scalars`)
    features: tuple[str, ...] = ()  # it has an effect only with all of these (`config.FEATURES`)
    flag: str | None = None  # the flag that sets it; None: there is none (`penalty`: the algorithm's name sets it)
    auto: str | None = None  # the switch that the word `auto` turns on instead
    default_text: str = ""  # what `--help` shows if the default depends on other things
    formerly: str | None = None  # its name in older files

    def expects(self) -> str:
        """The values that it may have, in words: `a whole number of at least 1`."""
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        if self.type is bool:
            return "true or false"
        if self.type is str:
            return "a word"
        if self.type not in (int, float):
            return f"layer widths, up to {MAX_LAYERS} whole numbers from 1 to {MAX_WIDTH} as in 256,256"
        kind = "a whole number" if self.type is int else "a number"
        low, high = (str(int(x)) if math.isfinite(x) and x == int(x) else f"{x:f}" for x in (self.low, self.high))
        return f"{kind} of at least {low}" if self.high == math.inf else f"{kind} from {low} to {high}"

    def check(self, value: Any) -> None:
        """Raises ConfigError if `value` is invalid whatever the other settings are."""
        if self.choices:
            valid = value in self.choices
        elif self.type is bool:
            valid = isinstance(value, bool)
        elif self.type is str:
            valid = isinstance(value, str)
        elif self.type in (int, float):
            return self._check_number(value)
        else:
            valid = isinstance(value, tuple | list) and 1 <= len(value) <= MAX_LAYERS
            valid = valid and all(type(width) is int and 1 <= width <= MAX_WIDTH for width in value)
        if not valid:
            raise ConfigError(self.flag or self.name, f"expects {self.expects()}, not {_brief(value)}")

    def _check_number(self, value: Any) -> None:
        kinds, largest = ((int,), LARGEST_INTEGER) if self.type is int else ((int, float), LARGEST_NUMBER)
        if isinstance(value, bool) or not isinstance(value, kinds) or not self.low <= value <= min(self.high, largest):
            too_large = isinstance(value, kinds) and value > largest and self.high == math.inf
            limit = f" and at most {largest}" if too_large else ""
            raise ConfigError(self.flag or self.name, f"expects {self.expects()}{limit}, not {value!r}")


def setting(default: Any, help: str, **about: Any) -> Any:
    """A dataclass field with its default, its line in `--help` and further fields of `Setting`."""
    return dataclasses.field(default=default, metadata={_KEY: {"help": help} | about})


@functools.cache
def settings_of(config: type) -> dict[str, Setting]:
    """The settings of a configuration class by name, in their order."""
    types = get_type_hints(config)
    return {
        field.name: Setting(
            **{"name": field.name, "type": types[field.name], "default": field.default, "flag": field.name}
            | field.metadata[_KEY]
        )
        for field in dataclasses.fields(config)
        if _KEY in field.metadata
    }


def current_names(settings: Mapping[str, Any], known: Mapping[str, Setting]) -> dict[str, Any]:
    """Settings of an older file under the names of today."""
    renamed = {about.formerly: name for name, about in known.items() if about.formerly}
    return {renamed.get(name, name): value for name, value in settings.items()}


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 100 else f"{text[:100]}..."
