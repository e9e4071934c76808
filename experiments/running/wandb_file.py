"""The file `wandb.json` of a run: the id of its runs in Weights & Biases, and the last row that was sent."""

import json
import re
import secrets
from pathlib import Path
from typing import NamedTuple

from experiments.running import files

NAME = "wandb.json"
MAX_BYTES = 10_000


class Sent(NamedTuple):
    """What was given to W&B so far."""

    id: str  # a member's run is `id-INDEX`
    env_steps: int = -1  # of the last row; -1: none


def read(folder: Path) -> Sent:
    """The content of wandb.json, or a new id if there is no such file or it is damaged."""
    try:
        content = files.read_json(folder / NAME, MAX_BYTES)
        sent = Sent(**content)
    except (OSError, ValueError, TypeError):
        return _new()
    valid = isinstance(sent.id, str) and re.fullmatch(r"[0-9a-f]{12}", sent.id)
    return sent if valid and type(sent.env_steps) is int else _new()


def write(folder: Path, sent: Sent) -> None:
    """Writes wandb.json, completely or not at all. Raises `OSError`."""
    with files.atomic_file(folder / NAME) as file:
        file.write((json.dumps(sent._asdict()) + "\n").encode())


def _new() -> Sent:
    return Sent(secrets.token_hex(6))
