"""The ring against a plain deque, uniform sampling, and that an insert's cost does not grow with the capacity."""

import re
from collections import deque
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sqt_jax import replay
from sqt_jax.types import Transition

pytestmark = pytest.mark.usefixtures("strict_dtypes")

O, A, BATCH = 3, 2, 32
CAPACITY = 6


def transitions(ids) -> Transition:
    """Transitions of which every number tells the id (from 1): a batch mixed out of two rows shows."""
    ids = np.asarray(ids, np.float32)
    obs, action = np.stack([ids + 0.25 * i for i in range(O)], -1), np.stack([-ids - 0.25 * i for i in range(A)], -1)
    return Transition(obs, action, 10 * ids, obs + 0.5, (ids % 2).astype(np.float32))


@cache
def compiled(capacity=CAPACITY, batch=BATCH):
    buffer = replay.uniform(capacity, batch, O, A)
    return buffer.init, jax.jit(buffer.insert), jax.jit(buffer.sample)


def assert_same(ours: Transition, theirs: Transition):
    for name, a, b in zip(Transition._fields, ours, theirs, strict=True):
        np.testing.assert_array_equal(a, b, err_msg=name)


def test_pack_and_unpack_are_inverse(maybe_jit):
    batch = transitions(np.arange(1, 9).reshape(2, 4))  # any leading axes
    rows = maybe_jit(replay.pack)(batch)
    assert rows.shape == (2, 4, replay.row_width(O, A)) == (2, 4, 2 * O + A + 2)
    assert_same(maybe_jit(lambda rows: replay.unpack(rows, O, A))(rows), batch)


def test_a_new_buffer_is_empty():
    state = replay.uniform(CAPACITY, BATCH, O, A).init()
    assert state.storage.shape == (CAPACITY, replay.row_width(O, A)) and state.storage.dtype == jnp.float32
    assert state.size == state.pointer == 0


@given(width=st.sampled_from([1, 2, 3, 6]), inserts=st.integers(0, 15), seed=st.integers(0, 1000))
def test_the_ring_is_a_deque_of_the_newest_rows(width, inserts, seed):
    init, insert, sample = compiled()
    state, model = init(), deque(maxlen=CAPACITY)
    for i in range(inserts):
        new = range(1 + i * width, 1 + (i + 1) * width)
        state = insert(state, transitions(new))
        model.extend(new)
        assert state.size == len(model)
        assert state.pointer == (i + 1) * width % CAPACITY
    if not inserts:
        return
    oldest_first = np.roll(state.storage, -int(state.pointer), axis=0)[CAPACITY - len(model) :]
    assert_same(replay.unpack(oldest_first, O, A), transitions(list(model)))
    batch, rows = sample(state, jax.random.key(seed))
    ids = np.asarray(batch.reward) / 10
    assert set(ids) <= set(model)  # so never an empty row, whose id would be 0
    assert_same(batch, transitions(ids))
    assert rows.shape == (BATCH,)
    assert_same(batch, replay.unpack(np.asarray(state.storage)[rows], O, A))


@pytest.mark.parametrize("filled", [1, 5, 8], ids=["one row", "partly", "full"])
def test_sampling_is_uniform_over_the_filled_rows(filled):
    init, insert, sample = compiled(capacity=8, batch=8000)
    state = init()
    for i in range(1, filled + 1):
        state = insert(state, transitions([i]))
    ids, counts = np.unique(sample(state, jax.random.key(0))[0].reward, return_counts=True)
    np.testing.assert_array_equal(ids, 10.0 * np.arange(1, filled + 1))
    assert filled == 1 or stats.chisquare(counts).pvalue > 1e-3


def test_another_key_samples_another_batch():
    init, insert, sample = compiled()
    state = insert(init(), transitions(range(1, CAPACITY + 1)))
    first, again, other = (sample(state, jax.random.key(seed))[1] for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)


def test_feedback_changes_nothing():
    buffer = replay.uniform(CAPACITY, BATCH, O, A)
    state = buffer.insert(buffer.init(), transitions(range(1, CAPACITY + 1)))
    after = buffer.feedback(state, jnp.arange(BATCH), jnp.full(BATCH, 1e6), jnp.int32(250))
    assert after is state


@pytest.mark.parametrize("width", [4, 5, 7, 12])
def test_an_insert_that_could_straddle_the_end_is_refused(width):
    buffer = replay.uniform(CAPACITY, BATCH, O, A)
    with pytest.raises(ValueError, match=f"multiple of the rows inserted at once .{width}."):
        buffer.insert(buffer.init(), transitions(range(width)))


MEMBER_AXES = replay.UniformState(storage=0, pointer=None, size=None)


def insert_alone(buffer):
    return buffer.insert, jax.eval_shape(buffer.init), ()


def insert_of_members(buffer, members=5):
    """As in a sweep: storage with a member axis, counters without."""
    state = jax.eval_shape(buffer.init)
    storage = jax.ShapeDtypeStruct((members, *state.storage.shape), state.storage.dtype)
    insert = jax.vmap(buffer.insert, in_axes=(MEMBER_AXES, 0), out_axes=MEMBER_AXES)
    return insert, state._replace(storage=storage), (members,)


def loop_of_members(buffer, members=5):
    """As in the training program: inserts and samples in a loop."""
    insert, state, leading = insert_of_members(buffer, members)

    def loop(state, transition):
        def body(i, carry):
            state, total = carry
            state = insert(state, transition)
            keys = jax.random.split(jax.random.fold_in(jax.random.key(0), i), members)
            batch, _ = jax.vmap(buffer.sample, in_axes=(MEMBER_AXES, 0))(state, keys)
            return state, total + jnp.sum(batch.reward)

        return jax.lax.fori_loop(0, 100, body, (state, jnp.zeros(())))

    return loop, state, leading


@pytest.mark.parametrize("program", [insert_alone, insert_of_members, loop_of_members], ids=lambda f: f.__name__)
def test_an_insert_writes_in_place_whatever_the_capacity(program):
    scratch = {}
    for capacity in (10_000, 1_000_000):
        insert, state, leading = program(replay.uniform(capacity, BATCH, O, A))
        new = jax.eval_shape(lambda leading=leading: jax.tree.map(jnp.asarray, transitions(np.ones((*leading, 2)))))
        executable = jax.jit(insert, donate_argnums=0).lower(state, new).compile()
        shape = ",".join(map(str, state.storage.shape))
        written = re.findall(rf"= f32\[{shape}\]\S* ([\w-]+)\(", executable.as_text())
        assert written, "the storage is not in the compiled text"
        assert not {"copy", "copy-start", "copy-done", "select", "scatter"} & set(written), set(written)
        memory = executable.memory_analysis()
        assert memory.alias_size_in_bytes >= np.prod(state.storage.shape) * 4  # the result is the donated argument
        scratch[capacity] = memory.temp_size_in_bytes
    assert scratch[1_000_000] == scratch[10_000] < 100_000
