"""What lies in a run's `checkpoint/` folder, and whether it is whole.

rows_0000000000_0000005000.bin   replay rows of these env steps of every member, float32 [S, rows, W]: written once
step_0000005000/state/           every other array of the training state, by Orbax
step_0000005000/manifest.json    what belongs to it, with sizes and CRCs, and where the run's other files stood
step_0000005000.1/               the same step once more, after its evaluation

Nothing that is read is executed, and no name of a file is taken from a file without being checked.
"""

import json
import re
import zlib
from pathlib import Path
from typing import Any, NamedTuple

from experiments.running import files
from experiments.running.loop import Position

FORMAT = 4  # another one where the training state, its files or the tables' columns are not what they were
MAX_BYTES = 10_000_000
STEP = re.compile(r"step_(\d{10})(?:\.(\d))?")
ROWS = re.compile(r"rows_(\d{10})_(\d{10})\.bin")


class Unusable(Exception):
    """A checkpoint that is damaged, and how."""


class Refused(Exception):
    """A run that cannot be gone on with as it is, and why: nothing may be taken from it, nor removed."""


class Step(NamedTuple):
    """A checkpoint's place: steps may be saved twice, before and after their evaluation."""

    env_steps: int
    again: int = 0

    @property
    def name(self) -> str:
        return f"step_{self.env_steps:010}" + (f".{self.again}" if self.again else "")


class Rows(NamedTuple):
    """A file of replay rows: those inserted at the env steps start < step <= stop."""

    start: int
    stop: int
    crc: int

    @property
    def name(self) -> str:
        return f"rows_{self.start:010}_{self.stop:010}.bin"


class Manifest(NamedTuple):
    state: dict[str, tuple[int, int]]  # size and CRC of each file below state/
    rows: list[Rows]
    position: Position
    lengths: dict[str, int]  # of the run's tables


def steps_in(folder: Path) -> list[Step]:
    """The checkpoints in a folder by their names, the earliest first."""
    matches = [STEP.fullmatch(item.name) for item in folder.iterdir()] if folder.is_dir() else []
    return sorted(Step(int(match[1]), int(match[2] or 0)) for match in matches if match)


def is_ours(name: str) -> bool:
    """Whether a file or folder of this name in a checkpoint folder is one that this module describes."""
    return re.fullmatch(rf"({STEP.pattern}|{ROWS.pattern})(\.part)?", name) is not None


def reaching(rows: list[Rows], env_steps: int, capacity: int) -> list[Rows]:
    """The files that hold rows of a replay of `capacity` after `env_steps`, or later ones."""
    return [file for file in rows if file.stop > env_steps - min(env_steps, capacity)]


def write(path: Path, manifest: Manifest) -> None:
    content: dict[str, Any] = {"format": FORMAT, "state": manifest.state, "rows": [file.name for file in manifest.rows]}
    content |= {"crc": [file.crc for file in manifest.rows], "position": manifest.position._asdict()}
    content |= {"lengths": manifest.lengths}
    content |= {"own_crc": own_crc(content)}
    with files.whole_file(path) as out:
        out.write(json.dumps(content).encode())


def read(folder: Path, step: Step) -> Manifest:
    """The manifest of a checkpoint in the run's checkpoint folder.

    Raises:
      Unusable: it is damaged.
      Refused: it is of another format.
    """
    path = folder / step.name
    if path.is_symlink():
        raise Unusable("it is a link")
    try:
        content = files.read_json(path / "manifest.json", MAX_BYTES)
        if content["format"] != FORMAT:
            raise Refused(f"its checkpoints are of format {str(content['format'])[:20]!r}, not {FORMAT}")
        if content.pop("own_crc") != own_crc(content):
            raise Unusable("its manifest.json is damaged")
        names = [ROWS.fullmatch(name) for name in content["rows"]]
        if not all(names):
            raise Unusable("rows of the replay are missing")
        rows = [Rows(int(m[1]), int(m[2]), int(crc)) for m, crc in zip(names, content["crc"], strict=True) if m]
        lengths = {str(name): int(length) for name, length in content["lengths"].items()}
        if min(lengths.values(), default=0) < 0:
            raise ValueError
        state = {str(name): (int(size), int(crc)) for name, (size, crc) in content["state"].items()}
        return Manifest(state, rows, _position(content["position"], step.env_steps), lengths)
    except (FileNotFoundError, ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise Unusable(f"its manifest.json cannot be read ({type(error).__name__})") from None
    except OSError as error:
        raise Refused(f"{step.name}/manifest.json cannot be read ({error.strerror})") from None


def verify(folder: Path, step: Step, manifest: Manifest, capacity: int, state_bytes: int, row_bytes: int) -> None:
    """Reads every byte of a checkpoint once, before anything is made of it.

    Args:
      capacity: of the replay.
      state_bytes, row_bytes: of the training state without its rows, and of the rows of one env step.

    Raises:
      Unusable: something is damaged or missing.
      Refused: a file is there and cannot be read.
    """
    found = files.below(folder / step.name / "state")
    if manifest.state.keys() != found.keys():
        raise Unusable("files are missing or are there too many")
    if sum(size for size, _ in manifest.state.values()) > 2 * state_bytes + 10_000_000:
        raise Unusable("its files are far larger than the state they hold")
    for name, (size, crc) in manifest.state.items():
        _check(found[name], name, size, crc)
    reached = step.env_steps - min(step.env_steps, capacity)
    if manifest.rows and manifest.rows[0].start <= reached:
        reached = manifest.rows[0].start
    for file in manifest.rows:
        if file.start != reached or not 0 < file.stop - file.start <= capacity:
            raise Unusable("rows of the replay are missing")
        _check(folder / file.name, file.name, row_bytes * (file.stop - file.start), file.crc)
        reached = file.stop
    if reached != step.env_steps:
        raise Unusable("rows of the replay are missing")


def own_crc(content: dict[str, Any]) -> int:
    """CRC-32 of what a manifest says: a number in it that changed would lead the run elsewhere, and nobody see it."""
    return zlib.crc32(json.dumps(content).encode())


def _position(values: dict[str, Any], env_steps: int) -> Position:
    """Raises ValueError, TypeError or KeyError where it is none of this step."""
    diverged = tuple((int(member), int(step)) for member, step in values["diverged"])
    position = Position(int(values["env_steps"]), int(values["evaluated"]), diverged, float(values["wall_seconds"]))
    if position.env_steps != env_steps or not -1 <= position.evaluated <= env_steps or not position.wall_seconds >= 0:
        raise ValueError
    return position


def _check(path: Path, name: str, size: int, crc: int) -> None:
    try:
        if path.is_symlink() or not path.is_file():
            raise Unusable(f"{name} is missing or is no file")
        if path.stat().st_size != size or files.crc(path) != crc:
            raise Unusable(f"{name} is damaged")
    except OSError as error:  # of the disk or the network, and perhaps not for long: no reason to give the file up
        raise Refused(f"{name} cannot be read ({error.strerror})") from None
