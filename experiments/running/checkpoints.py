"""A run's checkpoints: everything needed to resume bit for bit, in the files that `manifests` describes.

A checkpoint's folder gets its name when it is complete: a process that dies leaves a valid checkpoint or none. Replay
rows never change, so each checkpoint writes only the rows since the last one, from the device in pieces. Orbax writes
the other arrays, and the caller further files.
"""

import errno
import os
import shutil
import threading
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint
from absl import logging

from experiments.running import files, manifests
from experiments.running.loop import Position
from experiments.running.manifests import CannotResume, DamagedCheckpoint, Manifest, Rows, Step, rows_needed
from sqt_jax.members import Layout, every_leaf
from sqt_jax.train import TrainState, member_axes
from sqt_jax.trees import by_path, from_paths
from sqt_jax.types import Array, Replay, State

SPARE_BYTES = 1_000_000  # to be free in addition to a checkpoint
PIECE_BYTES = 64_000_000  # of replay rows on the host at a time


class Restored(NamedTuple):
    """A checkpoint that was read: the arguments of its `CheckpointStore.save`, and its folder."""

    state: TrainState
    position: Position
    lengths: dict[str, int]
    folder: Path  # with the further files that were saved in it


class CheckpointStore:
    """Writes and reads the checkpoints of one run.

    Args:
      path: the folder, which need not exist.
      replay: the run's replay, whose functions get and set the rows of its state.
      layout: the run's members and their devices. Files hold the members only, so the number of devices may change.
      keep: the number of checkpoints to keep, the latest ones.
      warn: called with a line of text when something fails. A checkpoint that cannot be written does not stop training.
    """

    def __init__(self, path: Path, replay: Replay, layout: Layout, keep: int, warn: Callable[[str], None]):
        self.path, self.replay, self.layout, self.keep, self.warn = path, replay, layout, keep, warn
        self._rows: list[Rows] = []  # files to keep, in order
        self._rows_end = 0  # env steps that they cover
        self._steps: dict[Step, int] = {}  # checkpoints to keep, in order -> env steps of their last evaluation
        self._writer: threading.Thread | None = None

        def rows(state: State, first: Array, count: int) -> Array:
            def own(state: State, first: Array) -> Array:
                return replay.rows(state, first, count)

            return layout.over_members(own, (replay.member_axes, None), 0)(state, first)

        def with_rows(state: State, rows: Array, first: Array) -> State:
            axes = replay.member_axes
            return layout.over_members(replay.with_rows, (axes, 0, None), axes)(state, rows, first)

        self._rows_of = jax.jit(rows, static_argnames="count")
        self._with_rows = jax.jit(with_rows, donate_argnums=0)
        self._row_width = jax.eval_shape(lambda: replay.rows(replay.init(), 0, 1)).shape[1]

    def save(
        self,
        state: TrainState,
        position: Position,
        lengths: dict[str, int],
        write_more: Callable[[Path], None] = lambda folder: None,
    ) -> None:
        """Writes the rows, copies the other arrays to the host, and writes these in a thread (`wait`).

        Args:
          lengths: bytes of each of the run's tables at this state.
          write_more: called in the thread with the checkpoint's folder: writes further files into it.
        """
        self.wait()
        same = [step for step in self._steps if step.env_steps == position.env_steps]
        if any(self._steps[step] == position.evaluated for step in same):
            return  # the same state, since training is deterministic
        try:
            self.path.mkdir(exist_ok=True)
            self._write_rows(state.replay, position.env_steps)
        except OSError as error:
            self._warn_of_failure(position.env_steps, error)
            return
        rest = self._without_rows(state)
        own = by_path(every_leaf(member_axes(self.replay), rest))
        arrays = {name: self._host_copy(leaf, name in own) for name, leaf in _non_empty(rest).items()}
        arguments = (Step(position.env_steps, len(same)), arrays, position, lengths, write_more)
        writer = threading.Thread(target=self._write, args=arguments, daemon=True)
        try:
            writer.start()
            self._writer = writer
        except RuntimeError:  # the system allows no more threads
            self._write(*arguments)

    def wait(self) -> None:
        """Returns when the checkpoint that is being written is on disk, or has failed."""
        if self._writer:
            self._writer.join()
            self._writer = None

    def newest(self) -> int | None:
        """The env steps of the newest checkpoint; None: there is none."""
        return max((step.env_steps for step in self._steps), default=None)

    def restore(self, template: TrainState) -> Restored | None:
        """The latest valid checkpoint, on the device; None if there is no checkpoint at all.

        Damaged checkpoints are reported to `warn`. Nothing is removed (`remove_others`).

        Args:
          template: shapes and dtypes of a state of the run's members without padding, from `jax.eval_shape`.

        Raises:
          CannotResume: no checkpoint is valid, or one cannot be read or belongs to another run.
        """
        valid: dict[Step, Manifest] = {}
        found = manifests.steps_in(self.path)
        for step in reversed(found):
            try:
                manifest = manifests.read(self.path, step)
                manifests.verify(self.path, step, manifest, self.replay.capacity, *self.sizes(template))
                valid[step] = manifest
            except DamagedCheckpoint as error:
                self.warn(f"the checkpoint at step {step.env_steps:,} cannot be used: {error}")
        if not valid:
            if found:
                raise CannotResume(f"none of its {len(found)} checkpoints is valid")
            return None
        valid = dict(list(valid.items())[: self.keep])
        latest, manifest = next(iter(valid.items()))
        state = self._read(latest, manifest, template)
        self._steps = {step: valid[step].position.evaluated for step in sorted(valid)}
        self._rows, self._rows_end = sorted({file for each in valid.values() for file in each.rows}), latest.env_steps
        folder = self.path / latest.name
        return Restored(state=state, position=manifest.position, lengths=manifest.lengths, folder=folder)

    def remove_others(self) -> None:
        """Removes checkpoint files that belong to none of the checkpoints to keep."""
        if not self.path.is_dir():
            return
        kept = {step.name for step in self._steps} | {file.name for file in self._rows}
        for item in self.path.iterdir():
            if item.name not in kept and manifests.is_checkpoint_file(item.name):
                _remove(item)

    def sizes(self, template: TrainState) -> tuple[int, int]:
        """Bytes of a checkpoint without replay rows, and of the rows of one env step; `template` as in `restore`."""
        rest = sum(_host_template(leaf).nbytes for leaf in jax.tree.leaves(self._without_rows(template)))
        return rest, 4 * self.layout.members * self._row_width

    def _write_rows(self, replay: State, stop: int) -> None:
        capacity = self.replay.capacity
        piece = max(1, PIECE_BYTES // (4 * self.layout.padded_size * self._row_width))
        start = max(self._rows_end, stop - capacity)
        while start < stop:
            in_ring = start % capacity
            count = min(piece, stop - start, capacity - in_ring)
            rows = np.asarray(self._rows_of(replay, jnp.int32(in_ring), count=count))[: self.layout.members].data
            file = Rows(start, start + count, zlib.crc32(rows))
            with files.atomic_file(self.path / file.name) as out:
                out.write(rows)
            self._rows.append(file)
            start = self._rows_end = start + count

    def _write(
        self,
        step: Step,
        arrays: dict[str, np.ndarray],
        position: Position,
        lengths: dict[str, int],
        write_more: Callable[[Path], None],
    ) -> None:
        capacity = self.replay.capacity
        part = self.path / f"{step.name}.part"
        try:
            _remove(part)
            # Before Orbax, whose threads print tracebacks when they meet a full disk.
            if shutil.disk_usage(self.path).free < 2 * sum(array.nbytes for array in arrays.values()) + SPARE_BYTES:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            _orbax().save(part.absolute() / "state", arrays)
            write_more(part)
            written = manifests.files_of(part)
            listed = {name: (path.stat().st_size, files.crc(path)) for name, path in written.items()}
            rows = rows_needed(self._rows, step.env_steps, capacity)
            manifest = Manifest(files=listed, rows=rows, position=position, lengths=lengths)
            manifests.write(part / manifests.MANIFEST, manifest)
            for path in {*written.values(), *(path.parent for path in written.values()), part}:
                files.sync(path)
            part.rename(self.path / step.name)
            files.sync(self.path)
        except Exception as error:  # Orbax raises many types, and none may end the training
            shutil.rmtree(part, ignore_errors=True)
            self._warn_of_failure(step.env_steps, error)
            return
        self._steps = dict([*self._steps.items(), (step, position.evaluated)][-self.keep :])
        self._rows = rows_needed(self._rows, next(iter(self._steps)).env_steps, capacity)
        self.remove_others()

    def _warn_of_failure(self, env_steps: int, error: Exception) -> None:
        last = f"the last valid one is at step {max(self._steps).env_steps:,}" if self._steps else "there is none yet"
        reason = " ".join(str(error).split())[:200]
        self.warn(f"no checkpoint at step {env_steps:,} ({reason}); {last}; training continues")

    def _read(self, step: Step, manifest: Manifest, template: TrainState) -> TrainState:
        """The state of a checkpoint whose files have been verified."""
        rest = self._without_rows(template)
        expected = {name: _host_template(leaf) for name, leaf in _non_empty(rest).items()}
        folder = (self.path / step.name / "state").absolute()
        try:
            on_disk = _shapes_on_disk(folder)
            if on_disk != {name: (leaf.shape, leaf.dtype.name) for name, leaf in expected.items()}:
                raise CannotResume("its checkpoints hold another training state than this run's")
            arrays = _orbax().restore(folder, expected)
        except CannotResume:
            raise
        except Exception as error:  # of any type, if Orbax did not write the folder
            raise CannotResume(f"Orbax cannot read its checkpoint ({type(error).__name__})") from None
        own = by_path(every_leaf(member_axes(self.replay), template))
        leaves = {
            # Leaves that are not on disk are empty, or are filled with the rows below.
            name: self._on_devices(arrays.get(name), leaf, name in own)
            for name, leaf in by_path(template).items()
        }
        state = from_paths(template, leaves)
        if int(state.env_steps) != step.env_steps:
            raise CannotResume(f"its checkpoint at step {step.env_steps:,} is of step {int(state.env_steps):,}")
        replay = state.replay
        for file in manifest.rows:
            rows = np.fromfile(self.path / file.name, np.float32).reshape(self.layout.members, -1, self._row_width)
            replay = self._with_rows(replay, self.layout.padded(rows), jnp.int32(file.start % self.replay.capacity))
        return state._replace(replay=replay)

    def _host_copy(self, leaf: Array, own: bool) -> np.ndarray:
        array = np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)
        # A copy: training reuses the memory while the file is written.
        return np.array(array[: self.layout.members] if own else array)

    def _on_devices(self, array: np.ndarray | None, like: Any, own: bool) -> Array:
        """`array` or zeros on the devices, of the shape of `like` except for the padding of members."""
        sharding = self.layout.sharding(0 if own else None)
        if array is None:
            return jnp.zeros(
                (self.layout.padded_size, *like.shape[1:]) if own else like.shape, like.dtype, device=sharding
            )
        placed = jax.device_put(self.layout.padded(array) if own else array, sharding)
        return jax.random.wrap_key_data(placed) if _is_key(like) else placed

    def _without_rows(self, state: TrainState) -> TrainState:
        return state._replace(replay=self.replay.without_rows(state.replay))


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _orbax() -> Any:
    logging.set_verbosity(logging.FATAL)  # it prints the failures that it also raises, with their tracebacks
    return orbax.checkpoint.Checkpointer(orbax.checkpoint.StandardCheckpointHandler())


def _shapes_on_disk(folder: Path) -> dict[str, tuple[tuple[int, ...], str]]:
    metadata = _orbax().metadata(folder).item_metadata.tree
    return {name: (tuple(leaf.shape), np.dtype(leaf.dtype).name) for name, leaf in metadata.items()}


def _non_empty(state: TrainState) -> dict[str, Any]:
    """The leaves by name, without empty arrays (Brax's environments have some), which Orbax cannot write."""
    return {name: leaf for name, leaf in by_path(state).items() if leaf.size}


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _host_template(leaf: Any) -> np.ndarray:
    """Zeros of the shape and dtype that a leaf has on disk."""
    shape = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
    return np.zeros(shape.shape, shape.dtype)
