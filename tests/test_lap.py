"""LAP's sums against NumPy, its sampling against exact probabilities, and what grows with the capacity."""

import re
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sqt_jax import lap
from sqt_jax.ring import Ring
from sqt_jax.types import Transition

pytestmark = pytest.mark.usefixtures("strict_dtypes")

O, A = 2, 1
EXPONENT, MIN_PRIORITY, REFRESH = 0.4, 1.0, 4
CAPACITY, BATCH = 1000, 16  # 1000 rows: 7 full blocks and one of 104 rows


def transitions(ids) -> Transition:
    """Transitions whose reward is the id (from 1), which distinguishes it from an empty row, which is all zeros."""
    ids = np.asarray(ids, np.float32)
    obs, action = np.repeat(ids[..., None], O, -1), np.repeat(-ids[..., None], A, -1)
    return Transition(obs, action, ids, obs + 1, np.ones_like(ids))


@cache
def compiled(num_envs=1, capacity=CAPACITY, batch=BATCH, min_mean_episode_length=1):
    ring = Ring(capacity, O, A, num_envs, min_mean_episode_length)
    buffer = lap.lap(ring, batch, EXPONENT, MIN_PRIORITY, REFRESH)
    return buffer.init, jax.jit(buffer.insert), jax.jit(buffer.sample), jax.jit(buffer.feedback)


@cache
def drawer(batch):
    return jax.jit(lambda key, levels: lap.draw_rows(key, levels, batch))


def build(priorities) -> tuple:
    """The levels over given priorities, by NumPy."""
    below, levels = np.asarray(priorities, np.float32), []
    while True:
        blocks = -(-len(below) // lap.BLOCK)
        level = np.zeros((blocks, lap.BLOCK), np.float32)
        level.ravel()[: len(below)] = below
        levels.append(jnp.asarray(level))
        if blocks == 1:
            return tuple(levels)
        below = level.sum(axis=1)


def assert_levels_agree(levels, priorities):
    """Every level is the sums of the blocks below it, the lowest one the priorities."""
    for ours, expected in zip(levels, build(priorities), strict=True):
        assert ours.shape == expected.shape
        np.testing.assert_allclose(ours, expected, rtol=1e-5)


def filled(rows=CAPACITY):
    """A buffer with `rows` rows, whose ids are 1, 2, ..."""
    return extended(compiled()[0](), np.arange(1, 1 + rows))


@jax.jit
def extended(state, ids):
    """The buffer after inserts of one row each."""
    insert = compiled()[1]
    return jax.lax.scan(lambda state, new: (insert(state, new), None), state, transitions_one_by_one(ids))[0]


def transitions_one_by_one(ids):
    obs, action = jnp.repeat(ids[:, None, None], O, -1), jnp.repeat(-ids[:, None, None], A, -1)
    one = Transition(obs, action, ids[:, None], obs + 1, jnp.ones_like(ids)[:, None])
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), one)


# Sums


@pytest.mark.parametrize(
    ("capacity", "blocks"),
    [(1, [1]), (128, [1]), (129, [2, 1]), (128**2, [128, 1]), (128**2 + 1, [129, 2, 1]), (10**6, [7813, 62, 1])],
)
def test_levels_shrink_by_the_block_size_down_to_one_block(capacity, blocks):
    state = jax.eval_shape(lap.lap(Ring(capacity, O, A), 1).init)
    assert [level.shape for level in state.levels] == [(count, lap.BLOCK) for count in blocks]


@given(data=st.data())
def test_all_sums_stay_those_of_a_plain_model(data):
    """Inserts and feedback at random; after each, every level is what NumPy sums up and nothing else has changed."""
    num_envs = data.draw(st.sampled_from([1, 50, 250]))
    init, insert, _, feedback = compiled(num_envs)
    generator = np.random.default_rng(data.draw(st.integers(0, 10**6)))
    state = init()
    priorities, highest, pointer, size = np.zeros(CAPACITY, np.float32), 1.0, 0, 0
    actions = data.draw(st.lists(st.sampled_from(["insert", "insert", "feedback"]), min_size=1, max_size=12))
    for step, action in enumerate(actions):
        if action == "insert":
            rows = np.arange(pointer, pointer + num_envs)
            state = insert(state, transitions(rows + 1.0))
            priorities[rows] = highest
            pointer, size = (pointer + num_envs) % CAPACITY, min(size + num_envs, CAPACITY)
        elif size:
            rows = generator.choice(size, size=min(BATCH, size), replace=False)
            rows = np.resize(rows, BATCH)  # few rows: duplicates, with equal errors
            error = np.resize(generator.lognormal(1, 2, size=min(BATCH, size)).astype(np.float32), BATCH)
            state = feedback(state, rows.astype(np.int32), error, jnp.int32(4 * step + 1))  # no refresh
            priorities[rows] = np.maximum(error, 1) ** np.float32(0.4)
            highest = max(highest, priorities[rows].max())
        assert_levels_agree(state.levels, priorities)
        np.testing.assert_array_equal(state.block_max, np.max(state.levels[0], axis=-1))
        np.testing.assert_allclose(state.max_priority, highest, rtol=1e-6)


def test_sums_do_not_drift():
    """Between 1e6 and 1e-6, so that sums which were adjusted would keep the rounding errors of the large ones."""
    levels = build(np.full(300, 1e-6))
    change = jax.jit(lap.set_priorities)
    rows = jnp.arange(300)
    for _ in range(5):
        levels = change(change(levels, rows, jnp.full(300, 1e6)), rows, jnp.full(300, 1e-6))
    assert_levels_agree(levels, np.full(300, 1e-6))


def test_duplicate_rows_leave_one_of_their_priorities_and_matching_sums():
    levels = jax.jit(lap.set_priorities)(
        build(np.ones(300)), jnp.array([7, 7, 200, 7]), jnp.array([2.0, 3.0, 5.0, 4.0])
    )
    assert levels[0][0, 7] in (2, 3, 4) and levels[0][1, 200 - 128] == 5
    assert_levels_agree(levels, np.ravel(levels[0])[:300])
    np.testing.assert_array_equal(levels[1][0, :3], [127 + levels[0][0, 7], 127 + 5, 44])


# Sampling

WEIGHTS = {
    "one row": np.array([0.3]),
    "one block": np.arange(1.0, 129),
    "not a multiple of the block": np.linspace(1, 5, 200),
    "two levels": 1 + np.arange(1000) % 7.0,
    "three levels": 1 + np.arange(20_000) % 5.0,
    "extreme": np.where(np.arange(700) % 100 == 3, 1e6, 1e-6),
    "extreme, the large ones last": np.where(np.arange(300) < 298, 1e-6, 1e6),
    "small ones that add up": np.where(np.arange(16_512) == 5, 16_512e-6, 1e-6),
}


@pytest.mark.parametrize("name", WEIGHTS)
def test_rows_are_drawn_with_their_exact_probabilities(name):
    weights, draws = WEIGHTS[name], 40_000
    rows = np.asarray(drawer(draws)(jax.random.key(3), build(weights)))
    assert rows.min() >= 0 and rows.max() < len(weights)
    probability = weights / weights.sum()
    # Cells of at least 20 expected draws: neighbouring rows together if a single one is too unlikely.
    cell = np.floor(np.cumsum(probability) * draws / 20).astype(int)
    cell = np.unique(np.append(0, cell[:-1]), return_inverse=True)[1]
    expected = np.bincount(cell, probability) * draws
    counts = np.bincount(cell[rows], minlength=len(expected))
    enough = expected >= 5
    assert counts[~enough].sum() <= 10 * (1 + expected[~enough].sum())
    observed, theory = np.append(counts[enough], counts[~enough].sum()), expected[enough]
    theory = np.append(theory, draws - theory.sum())
    kept = theory > 1e-3
    assert kept.sum() == 1 or stats.chisquare(observed[kept], theory[kept] * draws / theory[kept].sum()).pvalue > 1e-3


@pytest.mark.parametrize("block", range(2))
def test_within_a_block_each_row_has_its_own_probability(block):
    """Cell by cell, without the grouping of the test above; the other block makes up half of all draws."""
    weights = np.concatenate([np.arange(1.0, 129), np.full(72, 128 * 129 / 2 / 72)])
    rows = np.asarray(drawer(100_000)(jax.random.key(4), build(weights)))
    own = rows[rows // 128 == block] % 128
    expected = weights[128 * block : 128 * (block + 1)] / weights[:128].sum()
    assert stats.chisquare(np.bincount(own, minlength=len(expected)), expected * len(own)).pvalue > 1e-3
    assert abs(len(own) - 50_000) < 5 * 160


def uniform_draws(monkeypatch, value):
    def draws(key, shape):
        del key
        return jnp.full(shape, value, jnp.float32)

    monkeypatch.setattr(jax.random, "uniform", draws)


LARGEST_DRAW = 1 - 2**-23  # the largest value of `jax.random.uniform`


@pytest.mark.parametrize("u", [0.0, 1e-30, 0.5, LARGEST_DRAW])
@pytest.mark.parametrize("rows", [1, 3, 128, 129, 150, 16_385])
@pytest.mark.parametrize("large", [1.0, 1e6])
def test_an_empty_row_is_never_drawn(monkeypatch, u, rows, large):
    """A mostly empty buffer of a million rows, at the edges of the random numbers."""
    uniform_draws(monkeypatch, u)
    priorities = np.resize([1e-6, large, 0.7, 3.3, 11.1], rows)
    levels = tuple(jnp.zeros(shape) for shape in [(7813, 128), (62, 128), (1, 128)])
    levels = tuple(level.at[: len(own)].set(own) for level, own in zip(levels, build(priorities), strict=False))
    if len(levels) > len(build(priorities)):  # the levels above are those of the complete buffer
        levels = build(np.ravel(levels[0])[:1_000_000])
    row = lap.draw_rows(jax.random.key(0), levels, 4)
    assert np.all(row >= 0) and np.all(row < rows)


def test_an_empty_row_is_never_drawn_whatever_the_order_of_summation(monkeypatch):
    """Accelerators sum prefixes as trees: rounding may then let the cumulative sum grow where a weight is 0."""
    cumsum = jax.jit(lambda x, axis: jax.lax.associative_scan(jnp.add, x, axis=axis), static_argnames="axis")
    monkeypatch.setattr(jnp, "cumsum", lambda x, axis: cumsum(x, axis=axis % x.ndim))
    uniform_draws(monkeypatch, LARGEST_DRAW)
    generator = np.random.default_rng(0)
    weights = generator.uniform(0.5, 20, size=(4096, 128)).astype(np.float32)
    weights[np.arange(128) >= generator.integers(1, 128, size=(4096, 1))] = 0  # a start of each block is filled
    grows = np.diff(np.asarray(jnp.cumsum(weights, axis=-1)), axis=-1) != 0
    assert np.any(grows & (weights[:, 1:] == 0))  # the case occurs
    chosen = lap.draw(jax.random.key(0), jnp.asarray(weights))
    assert np.all(weights[np.arange(4096), chosen] > 0)


def test_a_batch_holds_the_rows_that_were_drawn():
    *_, sample, _ = compiled()
    state = filled(125)
    for seed in range(20):
        batch, rows = sample(state, jax.random.key(seed))
        assert rows.shape == (BATCH,) and rows.dtype == jnp.int32
        for ours, expected in zip(batch, transitions(np.asarray(rows) + 1), strict=True):
            np.testing.assert_array_equal(ours, expected)
        assert batch.reward.min() > 0  # an empty row's is 0


def test_another_key_draws_other_rows_and_levels_have_draws_of_their_own():
    levels = build(np.ones(128 * 128))
    first, again, other = (np.asarray(drawer(20_000)(jax.random.key(seed), levels)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.mean(first == other) < 0.01
    assert abs(np.corrcoef(first // 128, first % 128)[0, 1]) < 0.05


# Priorities


def test_the_priority_is_the_clipped_error_to_the_power(maybe_jit):
    error = jnp.array([0.0, 0.5, 1.0, 32.0])
    compute = maybe_jit(lambda error: lap.priority(error, 0.4, 1.0))
    np.testing.assert_allclose(compute(error), [1, 1, 1, 4], rtol=1e-6)  # 32^0.4 = 2^2
    np.testing.assert_allclose(lap.priority(error, 0.4, 0.03125), [0.25, 2**-0.4, 1, 4], rtol=1e-6)
    np.testing.assert_array_equal(lap.priority(error, 0.0, 1.0), np.ones(4))


def test_the_size_of_an_error_counts_and_one_that_is_not_finite_is_0():
    error = jnp.array([-32.0, jnp.nan, jnp.inf, -jnp.inf])
    np.testing.assert_allclose(lap.priority(error, 0.4, 1.0), [4, 1, 1, 1], rtol=1e-6)


def test_feedback_sets_only_the_priorities_of_its_rows():
    *_, feedback = compiled()
    rows = np.arange(0, 960, 60, dtype=np.int32)
    state = feedback(filled(), rows, jnp.full(BATCH, 32.0), jnp.int32(1))
    expected = np.ones(CAPACITY)
    expected[rows] = 4
    np.testing.assert_allclose(np.ravel(state.levels[0])[:CAPACITY], expected, rtol=1e-6)
    assert np.all(np.ravel(state.levels[0])[CAPACITY:] == 0)


def give(state, error, gradient_steps, rows=0):
    """Feedback of one error for rows `rows`, `rows` + 1, ..."""
    *_, feedback = compiled()
    return feedback(state, rows + jnp.arange(BATCH), jnp.full(BATCH, error), jnp.int32(gradient_steps))


def test_new_rows_get_the_largest_priority_seen():
    state = filled(100)
    assert state.max_priority == 1 and np.all(np.ravel(state.levels[0])[:100] == 1)
    state = give(state, 32.0, 1)
    np.testing.assert_allclose(state.max_priority, 4, rtol=1e-6)
    state = give(state, 0.0, 2)  # a smaller one later does not lower it, although no row has it any more
    state = extended(state, np.arange(101, 201))
    priorities = np.ravel(state.levels[0])
    np.testing.assert_allclose(priorities[100:200], 4, rtol=1e-6)
    np.testing.assert_array_equal(priorities[:100], 1)
    np.testing.assert_array_equal(priorities[200:], 0)


def test_the_maximum_becomes_the_buffers_only_every_few_updates():
    state, seen = filled(100), []
    for k, error in enumerate([1.0, 32.0, 1.0, 1.0, 1.0, 1.0, 243.0, 1.0], start=1):
        state = give(state, error, k)
        seen.append(float(state.max_priority))
    # REFRESH = 4: at 4 and 8 nothing above 1 is left in the buffer
    np.testing.assert_allclose(seen, [1, 4, 4, 1, 1, 1, 9, 1], rtol=1e-5)


def test_a_refresh_sees_rows_outside_the_batch_and_the_batch_itself():
    state = give(filled(), 32.0, 1)
    np.testing.assert_allclose(give(state, 243.0, 4).max_priority, 9, rtol=1e-5)
    np.testing.assert_allclose(give(state, 1.0, 4, rows=500).max_priority, 4, rtol=1e-6)


def test_a_row_that_is_overwritten_loses_its_old_priority():
    _, insert, *_ = compiled()
    state = give(give(filled(), 32.0, 1), 1.0, 4, rows=500)._replace(max_priority=jnp.float32(2))
    state = insert(state, transitions([1001]))
    np.testing.assert_allclose(np.ravel(state.levels[0])[:3], [2, 4, 4], rtol=1e-6)
    assert_levels_agree(state.levels, np.ravel(state.levels[0])[:CAPACITY])


@pytest.mark.parametrize("num_envs", [1, 2])
def test_a_row_that_lost_its_final_observation_is_not_drawn_any_more(num_envs):
    """Every episode is one step, and there is room for those of a tenth of the rows."""
    init, insert, *_ = compiled(num_envs, capacity=40, min_mean_episode_length=10)
    state, room = init(), 4 + num_envs
    for step in range(1, 60 // num_envs):
        state = insert(state, transitions(1 + step * 10 + np.arange(num_envs)))
        # The newest rows' next observations are not among the final ones yet.
        expected = np.zeros(40)
        newest = np.arange(step * num_envs)[-room - num_envs :]
        expected[newest % 40] = 1
        assert_levels_agree(state.levels, expected)
    gone = np.flatnonzero(expected == 0)[:BATCH]
    after = compiled(num_envs, capacity=40, min_mean_episode_length=10)[3](
        state, gone, np.full(BATCH, 32.0), jnp.int32(1)
    )
    assert_levels_agree(after.levels, expected)  # also for one that was lost since it was drawn


def test_a_restored_buffer_has_the_same_largest_priorities():
    ring = Ring(CAPACITY, O, A)
    buffer, state = lap.lap(ring, BATCH), give(filled(), 32.0, 1, rows=300)
    rest = buffer.without_rows(state)
    assert rest.block_max is None
    rest = rest._replace(rows=ring.init()._replace(inserted=state.rows.inserted))
    back = buffer.with_rows(rest, buffer.rows(state, 0, CAPACITY), 0)
    np.testing.assert_array_equal(back.block_max, state.block_max)
    assert sorted(set(np.asarray(back.block_max).tolist())) == [1, 4]


# Cost

MEMBERS = 3


def training_loop(capacity):
    """Insert, sample and feedback of a sweep's members in a loop, compiled as in the training program."""
    buffer = lap.lap(Ring(capacity, O, A, min_mean_episode_length=8), 64)
    axes = buffer.member_axes
    insert = jax.vmap(buffer.insert, in_axes=(axes, 0), out_axes=axes)
    sample = jax.vmap(buffer.sample, in_axes=(axes, 0))
    feedback = jax.vmap(buffer.feedback, in_axes=(axes, 0, 0, None), out_axes=axes)

    def loop(state, transition, key):
        def body(i, state):
            state = insert(state, transition)
            batch, rows = sample(state, jax.random.split(jax.random.fold_in(key, i), MEMBERS))
            return feedback(state, rows, jnp.abs(batch.reward), i)

        return jax.lax.fori_loop(0, 1000, body, state)

    state = jax.eval_shape(jax.vmap(lambda _: buffer.init(), out_axes=axes), jnp.arange(MEMBERS))
    new = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, transitions(np.ones((MEMBERS, 1)))))
    executable = jax.jit(loop, donate_argnums=0).lower(state, new, jax.random.key(0)).compile()
    return state, executable


@pytest.fixture(scope="module")
def loops():
    """Both capacities have three levels."""
    return {capacity: training_loop(capacity) for capacity in (300_000, 1_000_000)}


def held_shapes(state):
    """The shapes that grow with the capacity, as in the compiled text."""
    arrays = state.rows.storage, *state.levels[:-1], state.block_max, state.rows.final_obs, state.rows.final_owner
    return [shape_in_text(leaf) for leaf in arrays]


def shape_in_text(leaf):
    kind = {"float32": "f32", "int32": "s32"}[leaf.dtype.name]
    return f"{kind}[{','.join(map(str, leaf.shape))}]"


def instructions(text):
    """(computation, name, shape, operation, line) of each instruction of a compiled text."""
    computation, found = "", []
    for line in text.splitlines():
        if head := re.match(r"(?:ENTRY )?%([\w.-]+) \(.*\{$", line):
            computation = head[1]
        elif line_parts := re.match(r"\s+(?:ROOT )?%([\w.-]+) = (\w+\[[\d,]*\])\S* ([\w-]+)\(", line):
            found.append((computation, *line_parts.groups(), line))
    return found


def test_the_loop_over_members_writes_priorities_and_storage_in_place(loops):
    for state, executable in loops.values():
        lines = instructions(executable.as_text())
        for shape in held_shapes(state):
            kinds = {operation for _, _, own, operation, _ in lines if own == shape}
            assert kinds & {"scatter", "dynamic-update-slice"}, shape
            assert kinds <= {"scatter", "dynamic-update-slice", "fusion", "get-tuple-element", "parameter"}, kinds
        size = sum(4 * int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(state))
        assert executable.memory_analysis().alias_size_in_bytes == size  # the result is the donated argument


def test_no_sum_or_comparison_reads_all_priorities(loops):
    """Only the largest of each block are read at each step: one number for 128 rows."""
    for state, executable in loops.values():
        lines = instructions(executable.as_text())
        for shape in held_shapes(state):
            names = {(computation, name) for computation, name, own, *_ in lines if own == shape}
            readers = [
                line
                for computation, _, _, operation, line in lines
                for name in re.findall(r"%([\w.-]+)", line)
                if operation in ("reduce", "reduce-window") and (computation, name) in names
            ]
            assert bool(readers) == (shape == shape_in_text(state.block_max)), readers


def test_no_other_operation_grows_with_the_capacity(loops):
    """The two programs differ in the shapes of the state only."""
    programs = {}
    for capacity, (state, executable) in loops.items():
        held = held_shapes(state)
        shapes = [
            (operation, held.index(shape) if shape in held else shape)
            for _, _, shape, operation, _ in instructions(executable.as_text())
        ]
        programs[capacity] = sorted(map(str, shapes))
    small, large = programs.values()
    assert len(small) > 100 and small == large
    scratch = [executable.memory_analysis().temp_size_in_bytes for _, executable in loops.values()]
    assert max(scratch) - min(scratch) < 1000 and max(scratch) < 1_000_000
