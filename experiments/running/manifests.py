"""The files in a run's `checkpoint/` folder, and checking that they are complete.

rows_0000000000_0000005000.bin   replay rows of these env steps of every member, float32 [S, rows, W]; written once
step_0000005000/state/           every other array of the training state, written by Orbax
step_0000005000/policy/          the members' policies; policy_best/: those of their best evaluations (`run_policies`)
step_0000005000/manifest.json    the checkpoint's files with sizes and CRCs, and the lengths of the run's tables
step_0000005000.1/               a second checkpoint of the same step, after its evaluation

The files are treated as untrusted: nothing in them is executed, and file names in them are checked before use.
"""

import json
import re
import zlib
from pathlib import Path
from typing import Any, NamedTuple

from experiments.running import files
from experiments.running.loop import Position
from sqt_jax.policy_folders import CHECKPOINT as STEP

FORMAT = 5  # increased when the training state, its files or the tables' columns change
MAX_BYTES = 10_000_000
MANIFEST = "manifest.json"
ROWS = re.compile(r"rows_(\d{10})_(\d{10})\.bin")


class DamagedCheckpoint(Exception):
    """A checkpoint is damaged; an earlier one may be valid. The text says how."""


class CannotResume(Exception):
    """The run cannot be resumed, and nothing in its folder may be changed. The text says why."""


class Step(NamedTuple):
    """Identifies a checkpoint. A step can have two: before and after its evaluation."""

    env_steps: int
    repeat: int = 0  # 1 for the second one

    @property
    def name(self) -> str:
        """Of the checkpoint's folder."""
        return f"step_{self.env_steps:010}" + (f".{self.repeat}" if self.repeat else "")


class Rows(NamedTuple):
    """A file of the replay rows inserted at the env steps start < step <= stop."""

    start: int
    stop: int
    crc: int

    @property
    def name(self) -> str:
        """Of the file."""
        return f"rows_{self.start:010}_{self.stop:010}.bin"


class Manifest(NamedTuple):
    """The content of a checkpoint's manifest.json."""

    files: dict[str, tuple[int, int]]  # size and CRC of each file below its folder, without the manifest's own
    rows: list[Rows]
    position: Position
    lengths: dict[str, int]  # of the run's tables


def steps_in(folder: Path) -> list[Step]:
    """The checkpoints in a folder, from their names, the earliest first."""
    matches = [STEP.fullmatch(item.name) for item in folder.iterdir()] if folder.is_dir() else []
    return sorted(Step(int(match[1]), int(match[2] or 0)) for match in matches if match)


def is_checkpoint_file(name: str) -> bool:
    """Whether a file or folder of this name is part of a checkpoint, or of one that was not completed."""
    return re.fullmatch(rf"({STEP.pattern}|{ROWS.pattern})(\.part)?", name) is not None


def files_of(checkpoint: Path) -> dict[str, Path]:
    """The files that a manifest lists: all below a checkpoint's folder by their path in it, except the manifest."""
    return {name: path for name, path in files.below(checkpoint).items() if name != MANIFEST}


def rows_needed(rows: list[Rows], env_steps: int, capacity: int) -> list[Rows]:
    """The files with rows that a replay of `capacity` holds at `env_steps` or later."""
    return [file for file in rows if file.stop > env_steps - min(env_steps, capacity)]


def write(path: Path, manifest: Manifest) -> None:
    """Writes a manifest, completely or not at all. Raises `OSError`."""
    content: dict[str, Any] = {"format": FORMAT, "files": manifest.files, "rows": [file.name for file in manifest.rows]}
    content |= {"crc": [file.crc for file in manifest.rows], "position": manifest.position._asdict()}
    content |= {"lengths": manifest.lengths}
    content |= {"own_crc": own_crc(content)}
    with files.atomic_file(path) as out:
        out.write(json.dumps(content).encode())


def read(folder: Path, step: Step) -> Manifest:
    """The manifest of a checkpoint in the run's checkpoint folder.

    Raises:
      DamagedCheckpoint: it is damaged.
      CannotResume: it is of another format, or cannot be read.
    """
    path = folder / step.name
    if path.is_symlink():
        raise DamagedCheckpoint("it is a link")
    try:
        content = files.read_json(path / MANIFEST, MAX_BYTES)
        if content["format"] != FORMAT:
            raise CannotResume(f"its checkpoints are of format {str(content['format'])[:20]!r}, not {FORMAT}")
        if content.pop("own_crc") != own_crc(content):
            raise DamagedCheckpoint("its manifest.json is damaged")
        names = [ROWS.fullmatch(name) for name in content["rows"]]
        if not all(names):
            raise DamagedCheckpoint("rows of the replay are missing")
        rows = [Rows(int(m[1]), int(m[2]), int(crc)) for m, crc in zip(names, content["crc"], strict=True) if m]
        lengths = {str(name): int(length) for name, length in content["lengths"].items()}
        if min(lengths.values(), default=0) < 0:
            raise ValueError
        listed = {str(name): (int(size), int(crc)) for name, (size, crc) in content["files"].items()}
        position = _position(content["position"], step.env_steps)
        return Manifest(files=listed, rows=rows, position=position, lengths=lengths)
    except (FileNotFoundError, ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise DamagedCheckpoint(f"its manifest.json cannot be read ({type(error).__name__})") from None
    except OSError as error:
        raise CannotResume(f"{step.name}/manifest.json cannot be read ({error.strerror})") from None


def verify(folder: Path, step: Step, manifest: Manifest, capacity: int, state_bytes: int, row_bytes: int) -> None:
    """Checks the sizes and CRCs of all files of a checkpoint.

    Args:
      capacity: of the replay.
      state_bytes, row_bytes: bytes of the training state without its rows, and of the rows of one env step.

    Raises:
      DamagedCheckpoint: a file is damaged or missing.
      CannotResume: a file exists and cannot be read.
    """
    found = files_of(folder / step.name)
    if manifest.files.keys() != found.keys():
        raise DamagedCheckpoint("files are missing, or there are others")
    # Each of the two folders of policies holds a part of the state again.
    if sum(size for size, _ in manifest.files.values()) > 4 * state_bytes + 10_000_000:
        raise DamagedCheckpoint("its files are far larger than the state they hold")
    for name, (size, crc) in manifest.files.items():
        _check(found[name], name, size, crc)
    reached = step.env_steps - min(step.env_steps, capacity)
    if manifest.rows and manifest.rows[0].start <= reached:
        reached = manifest.rows[0].start
    for file in manifest.rows:
        if file.start != reached or not 0 < file.stop - file.start <= capacity:
            raise DamagedCheckpoint("rows of the replay are missing")
        _check(folder / file.name, file.name, row_bytes * (file.stop - file.start), file.crc)
        reached = file.stop
    if reached != step.env_steps:
        raise DamagedCheckpoint("rows of the replay are missing")


def own_crc(content: dict[str, Any]) -> int:
    """CRC-32 of a manifest's content: a changed number in it would otherwise change the run without notice."""
    return zlib.crc32(json.dumps(content).encode())


def _position(values: dict[str, Any], env_steps: int) -> Position:
    """The position in a manifest of the step `env_steps`. Raises ValueError, TypeError or KeyError if it is invalid."""
    diverged = tuple((int(member), int(step)) for member, step in values["diverged"])
    position = Position(
        env_steps=int(values["env_steps"]),
        evaluated=int(values["evaluated"]),
        diverged=diverged,
        wall_seconds=float(values["wall_seconds"]),
    )
    if position.env_steps != env_steps or not -1 <= position.evaluated <= env_steps or not position.wall_seconds >= 0:
        raise ValueError
    return position


def _check(path: Path, name: str, size: int, crc: int) -> None:
    try:
        if path.is_symlink() or not path.is_file():
            raise DamagedCheckpoint(f"{name} is missing or is not a file")
        if path.stat().st_size != size or files.crc(path) != crc:
            raise DamagedCheckpoint(f"{name} is damaged")
    except OSError as error:  # perhaps a temporary failure of the disk or network: the file may still be valid
        raise CannotResume(f"{name} cannot be read ({error.strerror})") from None
