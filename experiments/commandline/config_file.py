"""Reads a YAML file of settings (`--config=FILE.yaml`) as command-line arguments."""

from collections import Counter
from collections.abc import Container
from pathlib import Path
from typing import Any

import yaml

MAX_BYTES = 100_000
FOR_THE_COMMAND_LINE = ("config", "help", "resume")
SWITCH_WORDS = {"yes": "true", "on": "true", "no": "false", "off": "false"}


class InvalidConfigFile(ValueError):
    """A file is not a valid file of settings. The text says why, in one line."""


class _Loader(yaml.BaseLoader):
    """YAML whose words and numbers are text as written: `name: no` is "no", not false.

    Merge keys (`<<`) are not followed, since a few lines of them can exhaust the memory.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        for key, count in keys.items():
            if count > 1:
                raise InvalidConfigFile(f"expects each setting once, not {key[:50]} {count} times")
        return super().construct_mapping(node, deep)


def arguments(path: Path, switches: Container[str] = ()) -> list[str]:
    """`--name=value` for each line `name: value`, with the value as written; a list is joined by commas.

    Args:
      switches: the names that are true or false; YAML's yes, no, on and off count for these.

    Raises:
      InvalidConfigFile: there is no such file, or its content is invalid.
    """
    try:
        if not path.is_file():
            raise InvalidConfigFile("expects a file, which this is not" if path.exists() else "there is no such file")
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
        if len(text) > MAX_BYTES:
            raise InvalidConfigFile(f"expects a file of at most {MAX_BYTES} bytes")
        content = yaml.load(text.decode("utf-8"), _Loader)
    except InvalidConfigFile:
        raise
    except OSError as error:
        raise InvalidConfigFile(f"cannot be read: {error.strerror}") from None
    # In addition to its own errors, PyYAML passes on Python's for an invalid date, number or tag.
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError, OverflowError, RecursionError):
        raise InvalidConfigFile("expects a YAML file, which this is not") from None
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise InvalidConfigFile("expects lines like `steps: 100000`")
    return [_argument(key, value, key in switches) for key, value in content.items()]


def _argument(key: str, value: Any, switch: bool) -> str:
    if key in FOR_THE_COMMAND_LINE:
        raise InvalidConfigFile(f"{key} is for the command line")
    items = value if isinstance(value, list) else [value]
    if not all(isinstance(item, str) for item in items) or not any(items):
        raise InvalidConfigFile(f"{key} expects a number, a word or a list of them")
    if switch:
        items = [SWITCH_WORDS.get(item.lower(), item) for item in items]
    return f"--{key}={','.join(items)}"
