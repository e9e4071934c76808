"""The keyword arguments of an environment as text: `continuous=true,gravity=-9.8`.

Names may have dots, for entries of Playground's nested configurations: `reward_config.scales.energy=0`.
"""

import json
import re
from typing import Any

# A comma that begins the next `name=`: values may contain commas ([0.1,0.2], text).
SEPARATOR = re.compile(r",(?=[A-Za-z_][\w.]*=)", re.ASCII)
WORDS = {"True": True, "False": False, "None": None}
MAX_CHARACTERS = 2000


def parse(text: str) -> dict[str, Any]:
    """The arguments by name. A value is JSON (`true`, `-9.8`, `[1,2]`, `{"a":1}`), True, False, None, or else text.

    Raises:
      ValueError: an argument is not of the form NAME=VALUE, or is given twice.
    """
    arguments: dict[str, Any] = {}
    for part in SEPARATOR.split(text) if text else []:
        name, equals, value = part.partition("=")
        named = equals and all(word.isidentifier() for word in name.split("."))
        if not named or not text.isprintable() or len(text) > MAX_CHARACTERS:
            raise ValueError(f"expects NAME=VALUE,... as in continuous=true,gravity=-9.8, not {text[:100]!r}")
        if name in arguments:
            raise ValueError(f"expects each argument once, not {name} twice")
        arguments[name] = _value(value)
    return arguments


def _value(text: str) -> Any:
    if text in WORDS:
        return WORDS[text]
    try:
        return json.loads(text, parse_constant=str)  # NaN and Infinity stay text
    except (ValueError, RecursionError):
        return text
