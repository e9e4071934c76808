"""Checkpoints: exact, written once, complete or absent; a failure does not stop the run."""

import errno
import os

import algorithm_rows
import jax
import jax.numpy as jnp
import numpy as np
import probe_envs
import pytest
from test_train import identical, make, start

from experiments.running import checkpoints, files, manifests
from experiments.running.checkpoints import CheckpointStore
from experiments.running.loop import Position
from experiments.running.manifests import CannotResume
from sqt_jax import train
from sqt_jax.algorithms import ALGORITHMS
from sqt_jax.experiment import replay_of
from sqt_jax.members import Layout

SEEDS = (0, 1, 2)
CAPACITY = 64  # fewer than the steps: the ring overwrites rows
LENGTHS = {"evaluations": 10, "metrics": 20}


class Case:
    """A small sweep and its states."""

    def __init__(self, algo="td3_sqt", devices=1, make_env=probe_envs.one_step, **settings):
        small = {"embedding_size": 16} if "checkpoints" in ALGORITHMS[algo].features else {}
        self.config, trainer, self.sweep = make(algo, make_env, replay_capacity=CAPACITY, **small, **settings)
        self.replay = replay_of(self.config, make_env())
        self.template = jax.eval_shape(lambda: start(self.config, self.sweep))
        self.layout = Layout(len(SEEDS), tuple(jax.local_devices()[:devices]))
        if devices > 1:
            self.sweep = train.make_sweep(trainer, self.layout)

    def advance(self, state, env_steps, learn):
        return self.sweep.advance(state, env_steps // self.config.train.num_envs, learn)

    def trained(self, steps):
        state = self.advance(start(self.config, self.sweep, SEEDS), 40, False)
        return self.advance(state, steps - 40, True) if steps > 40 else state

    def store(self, folder, keep=2):
        self.said = []
        return CheckpointStore(folder / "checkpoint", self.replay, self.layout, keep, self.said.append)

    def saved(self, store, *steps):
        """Saves at these steps of one training; returns the state at the last one."""
        state = self.trained(40)
        for at in steps:
            state = self.advance(state, at - int(state.env_steps), at > 40)
            store.save(state, position(at), LENGTHS)
        store.wait()
        return state


def same(one, other):
    """Bit for bit, except final observations that no transition needs any more, which a checkpoint leaves out."""

    def held(state):
        replay = state.replay
        ring = getattr(replay, "rows", replay)
        stored = ring.storage[..., -1].astype(int)
        needed = jnp.any(stored[:, :, None] == jnp.arange(ring.final_obs.shape[1]), axis=1)
        final_obs = jnp.where(needed[..., None], ring.final_obs, 0.0)
        ring = ring._replace(final_obs=final_obs)
        return state._replace(replay=replay._replace(rows=ring) if hasattr(replay, "rows") else ring)

    return identical(held(one), held(other))


def position(at):
    return Position(at, 40, ((1, 30),), 2.5)


@pytest.fixture(scope="module")
def case():
    return Case()


def listing(store):
    return sorted(path.name for path in store.path.iterdir())


@algorithm_rows.every(fast=("td7_sqt_tuple",))  # the other tests here use td3_sqt
def test_every_algorithm_resumes_bit_for_bit(algo, tmp_path):
    case = Case(algo)
    store = case.store(tmp_path)
    state = case.saved(store, 50, 90)
    restored = case.store(tmp_path).restore(case.template)
    assert restored.position == position(90) and restored.lengths == LENGTHS
    assert same(restored.state, state)
    assert same(case.sweep.advance(restored.state, 30, True), case.sweep.advance(state, 30, True))
    assert case.said == []


def test_a_restored_state_needs_no_new_compilation(case, tmp_path):
    store = case.store(tmp_path)
    case.saved(store, 60)
    compiled = case.sweep.advance._cache_size()
    case.sweep.advance(store.restore(case.template).state, 3, True)
    assert case.sweep.advance._cache_size() == compiled


def test_training_continues_while_a_checkpoint_is_written(case, tmp_path):
    store = case.store(tmp_path)
    state = case.trained(60)
    store.save(state, position(60), LENGTHS)
    case.sweep.advance(state, 20, True)  # donates the memory of the arrays being written
    store.wait()
    assert same(store.restore(case.template).state, case.trained(60))


def test_only_filled_rows_are_written_and_each_once(case, tmp_path):
    store = case.store(tmp_path)
    case.saved(store, 45, 60)
    rows = sorted(store.path.glob("rows_*"))
    assert [path.name for path in rows] == ["rows_0000000000_0000000045.bin", "rows_0000000045_0000000060.bin"]
    width = 2 * 1 + 1 + 3
    assert sum(path.stat().st_size for path in rows) == 60 * len(SEEDS) * width * 4
    assert case.store(tmp_path).sizes(case.template)[1] == len(SEEDS) * width * 4


def test_rows_are_written_in_pieces(case, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoints, "PIECE_BYTES", 10 * len(SEEDS) * 6 * 4)
    store = case.store(tmp_path)
    state = case.saved(store, 60, 100)
    sizes = [path.stat().st_size for path in store.path.glob("rows_*")]
    assert max(sizes) <= checkpoints.PIECE_BYTES and len(sizes) >= 10
    assert same(store.restore(case.template).state, state)


def test_the_latest_are_kept_with_the_rows_they_need(case, tmp_path):
    store = case.store(tmp_path, keep=2)
    case.saved(store, 50, 60, 70, 80, 130)
    kept = listing(store)
    assert [name for name in kept if name.startswith("step")] == ["step_0000000080", "step_0000000130"]
    # The checkpoint at 80 needs rows 16 to 80; those up to 50 came in one file.
    assert [name for name in kept if name.startswith("rows")][0] == "rows_0000000000_0000000050.bin"
    store = case.store(tmp_path / "one", keep=1)
    store.path.parent.mkdir()
    case.saved(store, 50, 60, 70, 80, 130)
    assert listing(store)[0] == "rows_0000000064_0000000070.bin"  # rows 66 to 130, of the files that hold them


def test_a_step_is_saved_once(case, tmp_path):
    store = case.store(tmp_path)
    state = case.saved(store, 60)
    before = {path: path.stat().st_mtime_ns for path in store.path.rglob("*")}
    store.save(state, position(60), LENGTHS)
    store.wait()
    assert {path: path.stat().st_mtime_ns for path in store.path.rglob("*")} == before


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def disk_is_full_for_rows(monkeypatch):
    monkeypatch.setattr(files, "atomic_file", full)


def disk_is_full_for_the_state(monkeypatch):
    class Orbax:
        save = full

    monkeypatch.setattr(checkpoints, "_orbax", Orbax)


def disk_is_full_for_the_manifest(monkeypatch):
    def atomic_file(path, original=files.atomic_file):
        return full() if path.name == "manifest.json" else original(path)

    monkeypatch.setattr(files, "atomic_file", atomic_file)


def test_further_files_are_written_into_the_checkpoint_and_verified_with_it(case, tmp_path):
    def write_more(folder):
        (folder / "more").mkdir()
        (folder / "more" / "file").write_text("mine")

    store = case.store(tmp_path)
    case.saved(store, 60)
    store.save(case.trained(70), position(70), LENGTHS, write_more)
    store.wait()
    folder = case.store(tmp_path).restore(case.template).folder
    assert folder == store.path / "step_0000000070" and (folder / "more" / "file").read_text() == "mine"
    (folder / "more" / "file").write_text("other")
    assert case.store(tmp_path).restore(case.template).position == position(60)
    assert "more/file is damaged" in case.said[0]

    def fails(folder):
        write_more(folder)
        full()

    store = case.store(tmp_path)
    store.save(case.trained(80), position(80), LENGTHS, fails)
    store.wait()
    assert "no checkpoint at step 80" in case.said[0] and not list(store.path.glob("step_0000000080*"))


@pytest.mark.parametrize(
    "fault",
    [disk_is_full_for_rows, disk_is_full_for_the_state, disk_is_full_for_the_manifest],
    ids=lambda f: f.__name__,
)
def test_a_full_disk_does_not_stop_training(case, tmp_path, fault):
    store = case.store(tmp_path)
    state = case.saved(store, 60)
    with pytest.MonkeyPatch.context() as monkeypatch:
        fault(monkeypatch)
        state = case.sweep.advance(state, 10, True)
        store.save(state, position(70), LENGTHS)
        store.wait()
    (warning,) = case.said
    assert "no checkpoint at step 70" in warning and "No space left" in warning
    assert "the last valid one is at step 60" in warning
    assert not [name for name in listing(store) if name.endswith(".part")]
    # The older one is still valid, and with room again there is a newer one.
    state = case.sweep.advance(state, 10, True)
    assert same(case.store(tmp_path).restore(case.template).state, case.trained(60))
    store = case.store(tmp_path)
    store.restore(case.template)
    store.save(state, position(80), LENGTHS)
    store.wait()
    assert same(case.store(tmp_path).restore(case.template).state, case.trained(80))


def test_freed_disk_space_is_used_by_the_same_process(case, tmp_path):
    store = case.store(tmp_path)
    state = case.saved(store, 60)
    with pytest.MonkeyPatch.context() as monkeypatch:
        disk_is_full_for_the_state(monkeypatch)
        state = case.sweep.advance(state, 10, True)
        store.save(state, position(70), LENGTHS)
        store.wait()
    state = case.sweep.advance(state, 10, True)
    store.save(state, position(80), LENGTHS)
    store.wait()
    assert same(case.store(tmp_path).restore(case.template).state, case.trained(80))


def test_a_resumed_run_keeps_as_many_checkpoints_as_the_flag_says(case, tmp_path):
    case.saved(case.store(tmp_path, keep=3), 50, 60, 130)
    store = case.store(tmp_path, keep=1)
    store.restore(case.template)
    store.remove_others()
    assert [name for name in listing(store) if name.startswith("step")] == ["step_0000000130"]
    assert same(case.store(tmp_path).restore(case.template).state, case.trained(130))


def test_without_a_checkpoint_nothing_is_restored(case, tmp_path):
    assert case.store(tmp_path).restore(case.template) is None


def test_incomplete_files_of_a_dead_process_are_removed(case, tmp_path):
    store = case.store(tmp_path)
    state = case.saved(store, 60)
    (store.path / "step_0000000070.part" / "state").mkdir(parents=True)
    (store.path / "rows_0000000060_0000000070.bin").write_bytes(b"x")
    (store.path / "rows_0000000070_0000000075.bin.part").write_bytes(b"x")
    (store.path / "notes.txt").write_text("not ours")
    before = listing(store)
    store = case.store(tmp_path)
    assert same(store.restore(case.template).state, state)
    assert listing(store) == before  # nothing is removed before the run certainly resumes
    store.remove_others()
    assert listing(store) == ["notes.txt", "rows_0000000000_0000000060.bin", "step_0000000060"]


def test_the_rows_of_older_checkpoints_outlive_a_resume(case, tmp_path):
    """The ring overwrites rows between the two: the later one does not need the first rows."""
    case.saved(case.store(tmp_path), 60, 130)
    store = case.store(tmp_path)
    store.restore(case.template)
    store.remove_others()
    (store.path / "step_0000000130" / "manifest.json").unlink()
    assert same(case.store(tmp_path).restore(case.template).state, case.trained(60))


def test_a_checkpoint_is_kept_if_a_file_cannot_be_read_now(case, tmp_path, monkeypatch):
    store = case.store(tmp_path)
    case.saved(store, 50, 60)
    before = listing(store)

    def crc(path):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as patch:
        patch.setattr(files, "crc", crc)
        with pytest.raises(CannotResume, match="cannot be read"):
            case.store(tmp_path).restore(case.template)
    assert case.said == [] and listing(store) == before


def test_another_format_is_rejected_and_kept(case, tmp_path, monkeypatch):
    store = case.store(tmp_path)
    case.saved(store, 50, 60)
    before = listing(store)
    monkeypatch.setattr(manifests, "FORMAT", 99)
    with pytest.raises(CannotResume, match="are of format '5', not 99"):
        case.store(tmp_path).restore(case.template)
    assert listing(store) == before


def test_a_step_is_saved_again_after_its_evaluation(case, tmp_path):
    store = case.store(tmp_path)
    case.saved(store, 50, 60)
    state = train.new_interval(case.trained(60))
    store.save(state, position(60)._replace(evaluated=60), LENGTHS)
    store.wait()
    assert [name for name in listing(store) if name.startswith("step")] == ["step_0000000060", "step_0000000060.1"]
    restored = case.store(tmp_path).restore(case.template)
    assert restored.position.evaluated == 60 and identical(restored.state, state)


@pytest.mark.slow
def test_several_environments_per_member_fill_the_ring_interleaved(tmp_path):
    case = Case(num_envs=4)
    state = case.saved(case.store(tmp_path), 48, 100)
    restored = case.store(tmp_path).restore(case.template)
    assert same(restored.state, state)
    assert same(case.sweep.advance(restored.state, 5, True), case.sweep.advance(state, 5, True))


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["td3", "td7"])
def test_transitions_that_lost_their_final_observations_stay_lost(algo, tmp_path):
    case = Case(algo, make_env=probe_envs.shorter_than_stated)
    state = case.saved(case.store(tmp_path), 50, 130)
    assert np.all(case.replay.size(state.replay) == 1 + 64 / 8 + 1)  # the newest one's needs no room
    restored = case.store(tmp_path).restore(case.template)
    assert same(restored.state, state)
    assert same(case.advance(restored.state, 30, True), case.advance(state, 30, True))


def test_a_checkpoint_of_another_run_is_not_used(case, tmp_path):
    store = case.store(tmp_path)
    case.saved(store, 60)
    other = Case("sac")
    with pytest.raises(CannotResume, match="its checkpoints hold another training state than this run's"):
        other.store(tmp_path).restore(other.template)
    assert other.said == [] and identical(case.store(tmp_path).restore(case.template).state, case.trained(60))


@pytest.mark.skipif(len(jax.local_devices()) < 2, reason="one device only")
@pytest.mark.slow
def test_members_are_restored_on_any_devices_without_padding(case, tmp_path):
    two = Case(devices=2)
    state = two.saved(two.store(tmp_path), 50, 90)
    assert state.replay.storage.shape[0] == 4
    rows = sum(path.stat().st_size for path in (tmp_path / "checkpoint").glob("rows_*"))
    assert rows == 90 * len(SEEDS) * (state.replay.storage.shape[2] + 1) * 4
    again = two.store(tmp_path).restore(two.template).state
    assert same(again, state)
    assert jax.tree.map(lambda leaf: leaf.sharding.spec, again) == jax.tree.map(lambda leaf: leaf.sharding.spec, state)
    on_one = case.store(tmp_path).restore(case.template).state
    own = jax.tree.map(lambda leaf: leaf[:3] if leaf.ndim else leaf, state)
    assert same(jax.device_put(own, jax.local_devices()[0]), on_one)
    assert same(two.advance(again, 30, True), two.advance(state, 30, True))


def test_keys_are_restored_as_keys(case, tmp_path):
    store = case.store(tmp_path)
    case.saved(store, 50)
    key = store.restore(case.template).state.key
    assert jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    np.testing.assert_array_equal(jax.random.key_data(key), jax.random.key_data(case.trained(40).key))


def test_empty_arrays_are_restored_too(case, tmp_path):
    """Brax's environments have some."""

    def with_one(state):
        return state._replace(timestep=(state.timestep, jnp.zeros((len(SEEDS), 0, 2), jnp.int32)))

    store, state = case.store(tmp_path), with_one(case.trained(60))
    store.save(state, position(60), LENGTHS)
    store.wait()
    assert case.said == []
    assert same(store.restore(jax.eval_shape(lambda: with_one(start(case.config, case.sweep)))).state, state)
