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
    """What W&B was sent so far. Steps are environment steps of the last row; -1: none."""

    id: str  # a member's run is `id-INDEX`
    online: int = -1  # to the server
    offline: int = -1  # to files of the offline mode, which `wandb sync` sends later

    def with_row(self, env_steps: int, offline: bool) -> "Sent":
        """With the row at `env_steps`, sent to the server or to files."""
        if offline:
            return self._replace(offline=max(self.offline, env_steps))
        return self._replace(online=max(self.online, env_steps))


def read(folder: Path) -> Sent:
    """The content of wandb.json, or a new id if there is no such file or it is damaged."""
    try:
        content = files.read_json(folder / NAME, MAX_BYTES)
        sent = Sent(**content)
    except (OSError, ValueError, TypeError):
        return _new()
    valid = isinstance(sent.id, str) and re.fullmatch(r"[0-9a-f]{12}", sent.id)
    return sent if valid and type(sent.online) is type(sent.offline) is int else _new()


def write(folder: Path, sent: Sent) -> None:
    """Writes wandb.json, completely or not at all. Raises `OSError`."""
    with files.atomic_file(folder / NAME) as file:
        file.write((json.dumps(sent._asdict()) + "\n").encode())


def _new() -> Sent:
    return Sent(secrets.token_hex(6))
