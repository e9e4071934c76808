"""Checkpoints of a run, in `<run>/checkpoint/`: all that an exact continuation needs.

rows_0000000000_0000005000.bin   replay rows of these env steps of every member, float32 [S, rows, W]: written once
step_0000005000/state/           every other array of the training state, by Orbax
step_0000005000/manifest.json    what belongs to it, with sizes and CRCs, and where the run's other files stood

A checkpoint is the renaming of its finished folder: a process that dies leaves a whole one or none. Rows are immutable,
so that a checkpoint writes those alone that came since the last one, straight from the device in pieces. Nothing that
is read is executed, and no name of a file is taken from a file without being checked.
"""

import json
import re
import shutil
import threading
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments import files
from experiments.loop import Position
from sqt_jax.train import TrainState
from sqt_jax.trees import by_path, from_paths
from sqt_jax.types import Array, Replay

FORMAT = 1
PIECE_BYTES = 64_000_000  # of replay rows: what is held on the host at once
MAX_MANIFEST_BYTES = 10_000_000
STEP = re.compile(r"step_(\d{10})")
ROWS = re.compile(r"rows_(\d{10})_(\d{10})\.bin")


class Rows(NamedTuple):
    """A file of replay rows: those inserted at the env steps start < step <= stop."""

    start: int
    stop: int
    crc: int

    @property
    def name(self) -> str:
        return f"rows_{self.start:010}_{self.stop:010}.bin"


class Restored(NamedTuple):
    """What `save` was given."""

    state: TrainState
    position: Position
    lengths: dict[str, int]


class Unusable(Exception):
    """A checkpoint that cannot be used, and why."""


class Checkpoints:
    """Writes and reads the checkpoints of one run.

    Args:
      path: the folder, which need not exist.
      replay: the run's replay, which says where its state keeps its rows.
      keep: how many checkpoints are kept, the latest ones.
      warn: takes a line on what went wrong; a checkpoint that cannot be written is no reason to stop training.
    """

    def __init__(self, path: Path, replay: Replay, keep: int, warn: Callable[[str], None]):
        self.path, self.replay, self.keep, self.warn = path, replay, keep, warn
        self.seconds = 0.0
        self._rows: list[Rows] = []  # all that are on disk, in order
        self._rows_end = 0  # env steps that they reach
        self._steps: list[int] = []  # checkpoints that are on disk
        self._writer: threading.Thread | None = None

    def save(self, state: TrainState, position: Position, lengths: dict[str, int]) -> None:
        """Writes the rows, copies the rest, and writes that while training goes on (`wait`).

        Args:
          lengths: how much of the run's tables belongs to this state.
        """
        self.wait()
        env_steps = position.env_steps
        if env_steps in self._steps:
            return  # the same state, since training is deterministic
        try:
            self.path.mkdir(exist_ok=True)
            self._write_rows(self.replay.storage(state.replay), env_steps)
        except OSError as error:
            self._failed(env_steps, error)
            return
        arrays = {name: _host_copy(leaf) for name, leaf in by_path(self._without_rows(state)).items()}
        capacity = self.replay.storage(state.replay).shape[1]
        self._writer = threading.Thread(target=self._write, args=(arrays, capacity, position, lengths), daemon=True)
        self._writer.start()

    def wait(self) -> None:
        """Returns when the checkpoint under way is on disk, or has failed."""
        if self._writer:
            self._writer.join()
            self._writer = None

    def restore(self, template: TrainState) -> Restored | None:
        """The state of the latest checkpoint that is whole, on the device; None where there is none.

        Args:
          template: shapes and types of the state, as `jax.eval_shape` gives them.

        Checkpoints that are not whole are named to `warn` and removed, with all that was written after the one that
        is used: training writes the same again.
        """
        for env_steps in sorted(self._on_disk(), reverse=True):
            try:
                rows, position, lengths = self._verify(env_steps, template)
                state = self._read(env_steps, rows, template)
            except Unusable as error:
                self.warn(f"the checkpoint at step {env_steps:,} cannot be used: {error}")
                continue
            self._rows, self._rows_end = rows, env_steps
            self._steps = [step for step in self._on_disk() if step <= env_steps]
            self._remove_others()
            return Restored(state, position, lengths)
        self._steps, self._rows, self._rows_end = [], [], 0
        self._remove_others()
        return None

    def sizes(self, template: TrainState) -> tuple[int, int]:
        """Bytes of a checkpoint without the replay, and of the replay's rows per env step."""
        rest = sum(_bytes(leaf) for leaf in jax.tree.leaves(self._without_rows(template)))
        members, _, width = self.replay.storage(template.replay).shape
        return rest, 4 * members * width

    # Writing.

    def _write_rows(self, storage: Array, stop: int) -> None:
        members, capacity, width = storage.shape
        piece = max(1, PIECE_BYTES // (4 * members * width))
        start = max(self._rows_end, stop - capacity)
        while start < stop:
            in_ring = start % capacity
            count = min(piece, stop - start, capacity - in_ring)
            rows = np.asarray(_slice(storage, in_ring, count)).data
            file = Rows(start, start + count, zlib.crc32(rows))
            with files.whole_file(self.path / file.name) as out:
                out.write(rows)
            self._rows.append(file)
            start = self._rows_end = start + count

    def _write(self, arrays: dict[str, np.ndarray], capacity: int, position: Position, lengths: dict[str, int]) -> None:
        env_steps = position.env_steps
        rows = _reaching(self._rows, env_steps, capacity)
        part = self.path / f"{_step_name(env_steps)}.part"
        try:
            _remove(part)
            _orbax().save(part.absolute() / "state", arrays)
            written = files.below(part / "state")
            state = {name: [path.stat().st_size, files.crc(path)] for name, path in written.items()}
            manifest = {"format": FORMAT, "state": state, "rows": [file.name for file in rows]}
            manifest |= {"crc": [file.crc for file in rows], "position": position._asdict(), "lengths": lengths}
            with files.whole_file(part / "manifest.json") as out:
                out.write(json.dumps(manifest).encode())
            part.rename(self.path / _step_name(env_steps))
            files.sync(self.path)
        except Exception as error:  # Orbax has many: none of them may end the training
            shutil.rmtree(part, ignore_errors=True)
            self._failed(env_steps, error)
            return
        self._steps = [*self._steps, env_steps][-self.keep :]
        self._rows = _reaching(self._rows, self._steps[0], capacity)
        self._remove_others()

    def _failed(self, env_steps: int, error: Exception) -> None:
        last = f"the one at step {self._steps[-1]:,} is whole" if self._steps else "there is none before it"
        reason = " ".join(str(error).split())[:200]
        self.warn(f"no checkpoint at step {env_steps:,} ({reason}); {last}, and the run goes on")

    def _remove_others(self) -> None:
        """Removes what belongs to no checkpoint that is kept."""
        if not self.path.is_dir():
            return
        wanted = {_step_name(step) for step in self._steps} | {file.name for file in self._rows}
        for item in self.path.iterdir():
            if item.name in wanted or not re.fullmatch(rf"({STEP.pattern}|{ROWS.pattern})(\.part)?", item.name):
                continue
            _remove(item)

    # Reading.

    def _on_disk(self) -> list[int]:
        if not self.path.is_dir():
            return []
        found = [STEP.fullmatch(item.name) for item in self.path.iterdir()]
        return sorted(int(match[1]) for match in found if match)

    def _verify(self, env_steps: int, template: TrainState) -> tuple[list[Rows], Position, dict[str, int]]:
        """Reads every byte of a checkpoint once, before anything is made of it."""
        folder = self.path / _step_name(env_steps)
        if folder.is_symlink():
            raise Unusable("it is a link")
        try:
            manifest = files.read_json(folder / "manifest.json", MAX_MANIFEST_BYTES)
            if manifest["format"] != FORMAT:
                raise Unusable(f"its format is {str(manifest['format'])[:20]!r}, not {FORMAT}")
            names, crcs = manifest["rows"], manifest["crc"]
            rows = [
                Rows(int(match[1]), int(match[2]), int(crc))
                for match, crc in zip(map(ROWS.fullmatch, names), crcs, strict=True)
                if match
            ]
            position = _position(manifest["position"], env_steps)
            lengths = {str(name): int(length) for name, length in manifest["lengths"].items()}
            if min(lengths.values(), default=0) < 0:
                raise ValueError
            expected = {str(name): (int(size), int(crc)) for name, (size, crc) in manifest["state"].items()}
        except (OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
            raise Unusable(f"its manifest.json cannot be read ({type(error).__name__})") from None
        found = files.below(folder / "state")
        if expected.keys() != found.keys():
            raise Unusable("files are missing or are there too many")
        state_bytes, row_bytes = self.sizes(template)
        if sum(size for size, _ in expected.values()) > 2 * state_bytes + 10_000_000:
            raise Unusable("its files are far larger than the state they hold")
        for name, (size, crc) in expected.items():
            _check(found[name], name, size, crc)
        capacity = self.replay.storage(template.replay).shape[1]
        reached = env_steps - min(env_steps, capacity)
        if len(rows) != len(names) or (rows and rows[0].start > reached):
            raise Unusable("rows of the replay are missing")
        reached = rows[0].start if rows else reached
        for file in rows:
            if file.start != reached or not 0 < file.stop - file.start <= capacity:
                raise Unusable("rows of the replay are missing")
            _check(self.path / file.name, file.name, row_bytes * (file.stop - file.start), file.crc)
            reached = file.stop
        if reached != env_steps:
            raise Unusable("rows of the replay are missing")
        return rows, position, lengths

    def _read(self, env_steps: int, rows: list[Rows], template: TrainState) -> TrainState:
        rest = self._without_rows(template)
        expected = {name: _on_host(leaf) for name, leaf in by_path(rest).items()}
        folder = (self.path / _step_name(env_steps) / "state").absolute()
        try:
            there = _shapes_on_disk(folder)
            if there != {name: (leaf.shape, leaf.dtype.name) for name, leaf in expected.items()}:
                raise Unusable("it holds another training state than this run's")
            arrays = _orbax().restore(folder, expected)
        except Unusable:
            raise
        except Exception as error:  # whatever Orbax says of a folder that is not its own
            raise Unusable(f"Orbax cannot read it ({type(error).__name__})") from None
        leaves = {name: _on_device(arrays[name], leaf) for name, leaf in by_path(rest).items()}
        state = from_paths(rest, leaves)
        if int(state.env_steps) != env_steps:
            raise Unusable(f"it is of step {int(state.env_steps):,}")
        shape = self.replay.storage(template.replay).shape
        storage = jnp.zeros(shape, jnp.float32)
        for file in rows:
            values = np.fromfile(self.path / file.name, np.float32).reshape(shape[0], -1, shape[2])
            storage = _write_slice(storage, values, file.start % shape[1])
        return state._replace(replay=self.replay.with_storage(state.replay, storage))

    def _without_rows(self, state: TrainState) -> TrainState:
        return state._replace(replay=self.replay.with_storage(state.replay, None))  # type: ignore[arg-type]


def _reaching(rows: list[Rows], env_steps: int, capacity: int) -> list[Rows]:
    """The files that hold rows of a replay of `capacity` after `env_steps`, or later ones."""
    return [file for file in rows if file.stop > env_steps - min(env_steps, capacity)]


def _position(values: dict[str, Any], env_steps: int) -> Position:
    """Raises ValueError, TypeError or KeyError where it is none of this step."""
    diverged = tuple((int(member), int(step)) for member, step in values["diverged"])
    position = Position(int(values["env_steps"]), int(values["evaluated"]), diverged, float(values["wall_seconds"]))
    if position.env_steps != env_steps or not -1 <= position.evaluated <= env_steps or position.wall_seconds < 0:
        raise ValueError
    return position


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _step_name(env_steps: int) -> str:
    return f"step_{env_steps:010}"


def _orbax() -> Any:
    import orbax.checkpoint  # takes a second: only where a checkpoint is written or read

    return orbax.checkpoint.Checkpointer(orbax.checkpoint.StandardCheckpointHandler())


def _shapes_on_disk(folder: Path) -> dict[str, tuple[tuple[int, ...], str]]:
    metadata = _orbax().metadata(folder).item_metadata.tree
    return {name: (tuple(leaf.shape), np.dtype(leaf.dtype).name) for name, leaf in metadata.items()}


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _host_copy(leaf: Array) -> np.ndarray:
    # A copy: training goes on in the same memory while it is written.
    return np.array(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _on_host(leaf: Any) -> np.ndarray:
    shape = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
    return np.zeros(shape.shape, shape.dtype)


def _on_device(array: np.ndarray, like: Any) -> Array:
    return jax.random.wrap_key_data(jnp.asarray(array)) if _is_key(like) else jnp.asarray(array)


def _bytes(leaf: Any) -> int:
    return _on_host(leaf).nbytes


def _slice(storage: Array, start: int, count: int) -> Array:
    return jax.lax.dynamic_slice_in_dim(storage, jnp.int32(start), count, axis=1)


def _write_slice(storage: Array, rows: np.ndarray, start: int) -> Array:
    return _update(storage, rows, jnp.int32(start))


_update = jax.jit(
    lambda storage, rows, start: jax.lax.dynamic_update_slice_in_dim(storage, rows, start, axis=1), donate_argnums=0
)


def _check(path: Path, name: str, size: int, crc: int) -> None:
    try:
        if path.is_symlink() or not path.is_file():
            raise Unusable(f"{name} is missing or is no file")
        if path.stat().st_size != size or files.crc(path) != crc:
            raise Unusable(f"{name} is damaged")
    except OSError as error:
        raise Unusable(f"{name} cannot be read ({error.strerror})") from None
