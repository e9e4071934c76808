"""Checkpoints of a run: all that an exact continuation needs, in the files that `manifests` describes.

A checkpoint is the renaming of its finished folder: a process that dies leaves a whole one or none. Rows of the replay
are immutable, so that a checkpoint writes those alone that came since the last one, straight from the device in pieces;
the rest is Orbax's.
"""

import shutil
import threading
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.running import files, manifests
from experiments.running.loop import Position
from experiments.running.manifests import Manifest, Refused, Rows, Step, Unusable, reaching
from sqt_jax.members import Layout, every_leaf
from sqt_jax.train import TrainState, member_axes
from sqt_jax.trees import by_path, from_paths
from sqt_jax.types import Array, Replay, State

PIECE_BYTES = 64_000_000  # of replay rows: what is held on the host at once


class Restored(NamedTuple):
    """What `save` was given."""

    state: TrainState
    position: Position
    lengths: dict[str, int]


class Checkpoints:
    """Writes and reads the checkpoints of one run.

    Args:
      path: the folder, which need not exist.
      replay: the run's replay, which says where its state keeps its rows.
      layout: the run's members and where they lie: on disk are theirs alone, whatever the devices.
      keep: how many checkpoints are kept, the latest ones.
      warn: expects a line on what went wrong; a checkpoint that cannot be written is no reason to stop training.
    """

    def __init__(self, path: Path, replay: Replay, layout: Layout, keep: int, warn: Callable[[str], None]):
        self.path, self.replay, self.layout, self.keep, self.warn = path, replay, layout, keep, warn
        self._rows: list[Rows] = []  # all that are wanted, in order
        self._rows_end = 0  # env steps that they reach
        self._steps: dict[Step, int] = {}  # checkpoints that are wanted, in order -> the step of their last evaluation
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

    def save(self, state: TrainState, position: Position, lengths: dict[str, int]) -> None:
        """Writes the rows, copies the rest, and writes that while training goes on (`wait`).

        Args:
          lengths: how much of the run's tables belongs to this state.
        """
        self.wait()
        same = [step for step in self._steps if step.env_steps == position.env_steps]
        if any(self._steps[step] == position.evaluated for step in same):
            return  # the same state, since training is deterministic
        try:
            self.path.mkdir(exist_ok=True)
            self._write_rows(state.replay, position.env_steps)
        except OSError as error:
            self._failed(position.env_steps, error)
            return
        rest = self._without_rows(state)
        own = by_path(every_leaf(member_axes(self.replay), rest))
        arrays = {name: self._host_copy(leaf, name in own) for name, leaf in _held(rest).items()}
        arguments = (Step(position.env_steps, len(same)), arrays, position, lengths)
        self._writer = threading.Thread(target=self._write, args=arguments, daemon=True)
        self._writer.start()

    def wait(self) -> None:
        """Returns when the checkpoint under way is on disk, or has failed."""
        if self._writer:
            self._writer.join()
            self._writer = None

    def restore(self, template: TrainState) -> Restored | None:
        """The state of the latest checkpoint that is whole, on the device; None where there is no checkpoint at all.

        Those that are not whole are named to `warn`. Nothing is removed (`remove_others`).

        Args:
          template: shapes and types of a state of the run's members alone, as `jax.eval_shape` gives them.

        Raises:
          Refused: none is whole, or one cannot be read or is of another run.
        """
        whole: dict[Step, Manifest] = {}
        found = manifests.steps_in(self.path)
        for step in reversed(found):
            try:
                manifest = manifests.read(self.path, step)
                manifests.verify(self.path, step, manifest, self.replay.capacity, *self.sizes(template))
                whole[step] = manifest
            except Unusable as error:
                self.warn(f"the checkpoint at step {step.env_steps:,} cannot be used: {error}")
        if not whole:
            if found:
                raise Refused(f"none of its {len(found)} checkpoints is whole")
            return None
        whole = dict(list(whole.items())[: self.keep])
        latest, manifest = next(iter(whole.items()))
        state = self._read(latest, manifest, template)
        self._steps = {step: whole[step].position.evaluated for step in sorted(whole)}
        self._rows, self._rows_end = sorted({file for each in whole.values() for file in each.rows}), latest.env_steps
        return Restored(state, manifest.position, manifest.lengths)

    def remove_others(self) -> None:
        """Removes what belongs to no checkpoint that is wanted: training writes it again, or has no use for it."""
        if not self.path.is_dir():
            return
        wanted = {step.name for step in self._steps} | {file.name for file in self._rows}
        for item in self.path.iterdir():
            if item.name not in wanted and manifests.is_ours(item.name):
                _remove(item)

    def sizes(self, template: TrainState) -> tuple[int, int]:
        """Bytes of a checkpoint without the replay, and of the replay's rows per env step; `template` as above."""
        rest = sum(_on_host(leaf).nbytes for leaf in jax.tree.leaves(self._without_rows(template)))
        return rest, 4 * self.layout.members * self._row_width

    def _write_rows(self, replay: State, stop: int) -> None:
        capacity = self.replay.capacity
        piece = max(1, PIECE_BYTES // (4 * self.layout.held * self._row_width))
        start = max(self._rows_end, stop - capacity)
        while start < stop:
            in_ring = start % capacity
            count = min(piece, stop - start, capacity - in_ring)
            rows = np.asarray(self._rows_of(replay, jnp.int32(in_ring), count=count))[: self.layout.members].data
            file = Rows(start, start + count, zlib.crc32(rows))
            with files.whole_file(self.path / file.name) as out:
                out.write(rows)
            self._rows.append(file)
            start = self._rows_end = start + count

    def _write(self, step: Step, arrays: dict[str, np.ndarray], position: Position, lengths: dict[str, int]) -> None:
        capacity = self.replay.capacity
        part = self.path / f"{step.name}.part"
        try:
            _remove(part)
            _orbax().save(part.absolute() / "state", arrays)
            written = files.below(part / "state")
            state = {name: (path.stat().st_size, files.crc(path)) for name, path in written.items()}
            rows = reaching(self._rows, step.env_steps, capacity)
            manifests.write(part / "manifest.json", Manifest(state, rows, position, lengths))
            for folder in {path.parent for path in written.values()} | {part}:
                files.sync(folder)
            part.rename(self.path / step.name)
            files.sync(self.path)
        except Exception as error:  # Orbax has many: none of them may end the training
            shutil.rmtree(part, ignore_errors=True)
            self._failed(step.env_steps, error)
            return
        self._steps = dict([*self._steps.items(), (step, position.evaluated)][-self.keep :])
        self._rows = reaching(self._rows, next(iter(self._steps)).env_steps, capacity)
        self.remove_others()

    def _failed(self, env_steps: int, error: Exception) -> None:
        last = f"the one at step {max(self._steps).env_steps:,} is whole" if self._steps else "there is none before it"
        reason = " ".join(str(error).split())[:200]
        self.warn(f"no checkpoint at step {env_steps:,} ({reason}); {last}, and the run goes on")

    def _read(self, step: Step, manifest: Manifest, template: TrainState) -> TrainState:
        """The state of a checkpoint whose files have been verified."""
        rest = self._without_rows(template)
        expected = {name: _on_host(leaf) for name, leaf in _held(rest).items()}
        folder = (self.path / step.name / "state").absolute()
        try:
            there = _shapes_on_disk(folder)
            if there != {name: (leaf.shape, leaf.dtype.name) for name, leaf in expected.items()}:
                raise Refused("its checkpoints hold another training state than this run's")
            arrays = _orbax().restore(folder, expected)
        except Refused:
            raise
        except Exception as error:  # whatever Orbax says of a folder that is not its own
            raise Refused(f"Orbax cannot read its checkpoint ({type(error).__name__})") from None
        own = by_path(every_leaf(member_axes(self.replay), template))
        leaves = {
            # What is not there has no entries, or comes with the rows.
            name: self._on_devices(arrays.get(name), leaf, name in own)
            for name, leaf in by_path(template).items()
        }
        state = from_paths(template, leaves)
        if int(state.env_steps) != step.env_steps:
            raise Refused(f"its checkpoint at step {step.env_steps:,} is of step {int(state.env_steps):,}")
        replay = state.replay
        for file in manifest.rows:
            rows = np.fromfile(self.path / file.name, np.float32).reshape(self.layout.members, -1, self._row_width)
            replay = self._with_rows(replay, self.layout.filled(rows), jnp.int32(file.start % self.replay.capacity))
        return state._replace(replay=replay)

    def _host_copy(self, leaf: Array, own: bool) -> np.ndarray:
        array = np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)
        # A copy: training goes on in the same memory while it is written.
        return np.array(array[: self.layout.members] if own else array)

    def _on_devices(self, array: np.ndarray | None, like: Any, own: bool) -> Array:
        """`array`, or zeros, of the shape `like` but for the copies of members."""
        sharding = self.layout.sharding(0 if own else None)
        if array is None:
            return jnp.zeros((self.layout.held, *like.shape[1:]) if own else like.shape, like.dtype, device=sharding)
        there = jax.device_put(self.layout.filled(array) if own else array, sharding)
        return jax.random.wrap_key_data(there) if _is_key(like) else there

    def _without_rows(self, state: TrainState) -> TrainState:
        return state._replace(replay=self.replay.without_rows(state.replay))


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _orbax() -> Any:
    import orbax.checkpoint  # takes a second: only where a checkpoint is written or read

    return orbax.checkpoint.Checkpointer(orbax.checkpoint.StandardCheckpointHandler())


def _shapes_on_disk(folder: Path) -> dict[str, tuple[tuple[int, ...], str]]:
    metadata = _orbax().metadata(folder).item_metadata.tree
    return {name: (tuple(leaf.shape), np.dtype(leaf.dtype).name) for name, leaf in metadata.items()}


def _held(state: TrainState) -> dict[str, Any]:
    """The leaves by name, but for those without entries, such as Brax's environments carry: Orbax refuses them."""
    return {name: leaf for name, leaf in by_path(state).items() if leaf.size}


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _on_host(leaf: Any) -> np.ndarray:
    shape = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
    return np.zeros(shape.shape, shape.dtype)
