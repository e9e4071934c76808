"""The ring against a plain list, true next observations at the ends of episodes, and its cost in the compiled text."""

import re
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sqt_jax import replay
from sqt_jax.ring import Ring
from sqt_jax.types import Transition

pytestmark = pytest.mark.usefixtures("strict_dtypes")

O, A = 3, 2
CAPACITY = 12


class Stream:
    """Transitions of E environments whose episodes end at given steps; every number of a transition is unique."""

    def __init__(self, num_envs: int):
        self.num_envs, self.count = num_envs, 0
        self.obs = self._fresh()
        self.transitions: list[Transition] = []  # in the order of their numbers

    def _fresh(self):
        self.count += 1
        numbers = self.count * 100 + np.arange(self.num_envs * O, dtype=np.float32)
        return numbers.reshape(self.num_envs, O)

    def step(self, ends) -> Transition:
        """The next transitions; `ends [E]` bool: the episodes that end with them."""
        following = self._fresh()
        step = Transition(
            obs=self.obs,
            action=-self.obs[:, :A] - 0.5,
            reward=self.obs[:, 0] + 0.25,
            next_obs=following,
            discount=(np.arange(self.num_envs) + self.count).astype(np.float32) % 2,
        )
        self.obs = np.where(np.asarray(ends)[:, None], self._fresh(), following)
        self.transitions += [Transition(*(leaf[e] for leaf in step)) for e in range(self.num_envs)]
        return step


@cache
def compiled(num_envs=1, min_mean_episode_length=1, capacity=CAPACITY):
    ring = Ring(capacity, O, A, num_envs, min_mean_episode_length)
    return ring, jax.jit(ring.insert), jax.jit(ring.read)


@partial(jax.jit, static_argnums=0)
def one_row(ring, state, first):
    return ring.rows(state, first, 1)


def filled(ring, insert, ends):
    """A ring after steps with these `ends [steps, E]`, the inserted transitions, and the numbers reported as lost."""
    state, stream, lost = ring.init(), Stream(ring.num_envs), []
    for row in ends:
        state, gone = insert(state, stream.step(row))
        lost += [int(number) for number in gone if number >= 0]
    return state, stream, lost


def readable(ring, read, state) -> tuple[range, list[Transition]]:
    """The numbers of the available transitions, and the transitions."""
    numbers = range(int(ring.oldest(state)), int(state.inserted))
    batch = read(state, jnp.array(list(numbers), jnp.int32) % ring.capacity)
    return numbers, [Transition(*(leaf[i] for leaf in batch)) for i in range(len(numbers))]


def assert_same(ours, theirs):
    for name, a, b in zip(Transition._fields, ours, theirs, strict=True):
        np.testing.assert_array_equal(a, b, err_msg=name)


def test_a_new_ring_is_empty():
    ring = Ring(CAPACITY, O, A)
    state = ring.init()
    assert state.storage.shape == (CAPACITY, O + A + 3) and state.storage.dtype == jnp.float32
    assert state.inserted == ring.oldest(state) == ring.size(state) == 0


@given(
    num_envs=st.sampled_from([1, 2, 4]),
    steps=st.integers(1, 20),
    how_often=st.floats(0, 1),
    seed=st.integers(0, 1000),
)
def test_it_holds_the_newest_transitions_with_their_true_next_observations(num_envs, steps, how_often, seed):
    ring, insert, read = compiled(num_envs)
    ends = np.random.default_rng(seed).random((steps, num_envs)) < how_often
    state, stream, lost = filled(ring, insert, ends)
    numbers, held = readable(ring, read, state)
    assert ring.size(state) == len(numbers)
    assert numbers == range(max(0, steps * num_envs - CAPACITY), steps * num_envs)
    for number, transition in zip(numbers, held, strict=True):
        assert_same(transition, stream.transitions[number])
    assert all(number < numbers.start for number in lost)  # room for an end at every step


@given(num_envs=st.sampled_from([1, 3]), shortest=st.integers(2, 12), how_often=st.floats(0, 1), data=st.data())
def test_if_episodes_are_shorter_than_the_bound_old_transitions_are_lost_and_none_is_wrong(
    num_envs, shortest, how_often, data
):
    ring, insert, read = compiled(num_envs, shortest)
    ends = np.random.default_rng(data.draw(st.integers(0, 1000))).random((15, num_envs)) < how_often
    state, stream, lost = filled(ring, insert, ends)
    numbers, held = readable(ring, read, state)
    for number, transition in zip(numbers, held, strict=True):
        assert_same(transition, stream.transitions[number])
    # Missing transitions are older than a lost one, or than the ring.
    assert numbers.start == max(15 * num_envs - CAPACITY, max(lost, default=-1) + 1)
    # Ends that the newest step made are not written yet.
    later = ends.ravel()[: 14 * num_envs]
    kept = np.flatnonzero(later)[-ring.final_capacity :]
    assert state.num_finals == later.sum()
    assert sorted(np.asarray(state.final_owner)[np.asarray(state.final_owner) >= 0]) == kept.tolist()
    assert numbers.start <= max(15 * num_envs - CAPACITY, kept[0] if len(kept) == ring.final_capacity else 0)


def test_room_for_final_observations_follows_from_the_episode_length():
    assert Ring(1000, O, A).final_capacity == 1001
    assert Ring(1_000_000, O, A, min_mean_episode_length=1000).final_capacity == 1001
    assert Ring(1000, O, A, num_envs=8, min_mean_episode_length=8).final_capacity == 133
    assert Ring(2**30, O, A).final_capacity == 2**24  # indices up to there are exact in float32


def test_a_final_observation_that_the_next_episode_starts_with_needs_no_room():
    ring, insert, read = compiled()
    state = ring.init()
    one = Transition(np.ones((1, O)), np.zeros((1, A)), np.ones(1), np.ones((1, O)), np.zeros(1))
    one = jax.tree.map(np.float32, one)
    for _ in range(3):
        state, _ = insert(state, one)
    assert state.num_finals == 0
    assert_same(read(state, jnp.array([1])), one)


@pytest.mark.parametrize("width", [1, 3, 4])
def test_any_number_but_one_transition_per_environment_is_rejected(width):
    ring = Ring(CAPACITY, O, A, num_envs=2)
    with pytest.raises(ValueError, match=r"expected transitions of {'obs': \(2, "):
        ring.insert(ring.init(), Stream(width).step(np.zeros(width, bool)))


@pytest.mark.parametrize("field", Transition._fields)
def test_transitions_of_other_sizes_are_rejected(field):
    """A narrower row would be written without complaint, its columns one place too early."""
    ring, one = Ring(CAPACITY, O, A), Stream(1).step(np.zeros(1, bool))
    ring.insert(ring.init(), one)
    narrow = one._replace(**{field: getattr(one, field)[..., :0] if field in ("obs", "action", "next_obs") else 0.0})
    with pytest.raises(ValueError, match=rf"expected transitions of .*, got .*'{field}': \("):
        ring.insert(ring.init(), narrow)


@pytest.mark.parametrize("capacity", [0, 1, 3, 13])
def test_a_capacity_that_is_no_multiple_of_an_insert_is_rejected(capacity):
    with pytest.raises(ValueError, match=f"capacity .{capacity}. must be a multiple of the rows inserted at once .2."):
        Ring(capacity, O, A, num_envs=2).init()


# Members of a sweep


@pytest.mark.parametrize("num_envs", [1, 2])
def test_members_have_their_own_of_every_field_except_the_number_of_inserted_transitions(num_envs):
    """Two members, one whose episodes end at every step and one whose never do, equal the same members alone."""
    ring = Ring(CAPACITY, O, A, num_envs, min_mean_episode_length=4)
    axes = ring.member_axes()
    assert axes.inserted is None and set(axes._replace(inserted=0)) == {0}
    streams, alone = (Stream(num_envs), Stream(num_envs)), [ring.init(), ring.init()]
    together = jax.vmap(lambda _: ring.init(), out_axes=axes)(jnp.arange(2))
    insert, insert_alone = jax.jit(jax.vmap(ring.insert, (axes, 0), (axes, 0))), jax.jit(ring.insert)
    for _ in range(CAPACITY + 3):
        steps = [stream.step(np.full(num_envs, ends)) for stream, ends in zip(streams, (True, False), strict=True)]
        together, _ = insert(together, jax.tree.map(lambda *leaves: np.stack(leaves), *steps))
        alone = [insert_alone(state, step)[0] for state, step in zip(alone, steps, strict=True)]
    assert together.inserted.shape == () and together.num_finals.tolist() == [num_envs * (CAPACITY + 2), 0]
    for member, state in enumerate(alone):
        of_member = jax.tree.map(
            lambda leaf, m=member: leaf[m], together._replace(inserted=jnp.stack([together.inserted] * 2))
        )
        for name, a, b in zip(state._fields, of_member, state, strict=True):
            np.testing.assert_array_equal(a, b, err_msg=name)


# Rows in checkpoints


@given(
    num_envs=st.sampled_from([1, 3]),
    shortest=st.sampled_from([1, 5]),
    steps=st.integers(1, 25),
    how_often=st.floats(0, 1),
    seed=st.integers(0, 1000),
)
@settings(max_examples=8)
@pytest.mark.slow
def test_rows_saved_one_part_after_another_restore_everything(num_envs, shortest, steps, how_often, seed):
    ring, insert, read = compiled(num_envs, shortest)
    generator = np.random.default_rng(seed)
    state, stream, kept = ring.init(), Stream(num_envs), []
    written = 0
    for _ in range(steps):
        state, _ = insert(state, stream.step(generator.random(num_envs) < how_often))
        if generator.random() < 0.3 or int(state.inserted) - written > CAPACITY - num_envs:
            for number in range(written, int(state.inserted)):  # a row at a time: none crosses the end
                kept.append(np.asarray(one_row(ring, state, number % CAPACITY)))
            written = int(state.inserted)
    for number in range(written, int(state.inserted)):
        kept.append(np.asarray(one_row(ring, state, number % CAPACITY)))
    back = ring.without_rows(state)._replace(
        storage=jnp.zeros_like(state.storage), final_obs=jnp.zeros_like(state.final_obs)
    )
    # In pieces that end where the ring does, and older ones first.
    for start in range(0, len(kept), CAPACITY):
        back = ring.with_rows(back, jnp.concatenate(kept[start : start + CAPACITY]), 0)
    numbers, held = readable(ring, read, back)
    assert len(numbers) >= min(int(state.inserted), CAPACITY, num_envs + ring.final_capacity)
    for number, transition in zip(numbers, held, strict=True):
        assert_same(transition, stream.transitions[number])
    more = stream.step(np.ones(num_envs, bool))
    for a, b in zip(jax.tree.leaves(insert(state, more)[1]), jax.tree.leaves(insert(back, more)[1]), strict=True):
        np.testing.assert_array_equal(a, b)


def test_without_rows_only_small_arrays_remain():
    ring = Ring(10_000, O, A, min_mean_episode_length=1000)
    state = ring.init()
    rest = ring.without_rows(state)
    assert rest.storage is rest.final_obs is None
    assert sum(leaf.nbytes for leaf in jax.tree.leaves(rest)) < 0.001 * state.storage.nbytes


# Cost

BATCH = 32


def insert_alone(ring):
    return lambda state, transition: ring.insert(state, transition)[0], jax.eval_shape(ring.init), ()


def insert_of_members(ring, members=5):
    """As in a sweep: arrays with a member axis, the counter without."""
    axes = ring.member_axes()
    insert = jax.vmap(insert_alone(ring)[0], in_axes=(axes, 0), out_axes=axes)
    init = jax.vmap(lambda _: ring.init(), out_axes=axes)
    return insert, jax.eval_shape(init, jnp.arange(members)), (members,)


def loop_of_members(ring, members=5):
    """As in the training program: inserts and samples in a loop."""
    insert, state, leading = insert_of_members(ring, members)
    sample = jax.vmap(replay.uniform(ring, BATCH).sample, in_axes=(ring.member_axes(), 0))

    def loop(state, transition):
        def body(i, carry):
            state, total = carry
            state = insert(state, transition)
            keys = jax.random.split(jax.random.fold_in(jax.random.key(0), i), members)
            return state, total + jnp.sum(sample(state, keys)[0].next_obs)

        return jax.lax.fori_loop(0, 100, body, (state, jnp.zeros(())))

    return loop, state, leading


PROGRAMS = [insert_alone, insert_of_members, loop_of_members, partial(loop_of_members, members=1)]


@pytest.mark.parametrize("program", PROGRAMS, ids=["insert alone", "insert of members", "loop of members", "of one"])
@pytest.mark.parametrize("num_envs", [1, 2])
def test_an_insert_writes_in_place_whatever_the_capacity(program, num_envs):
    scratch = {}
    for capacity in (10_000, 1_000_000):
        insert, state, leading = program(Ring(capacity, O, A, num_envs, min_mean_episode_length=8))
        step = Stream(num_envs).step(np.zeros(num_envs, bool))
        one = Transition(*(jnp.zeros((*leading, *leaf.shape)) for leaf in step))
        executable = jax.jit(insert, donate_argnums=0).lower(state, one).compile()
        for array, kind in ((state.storage, "f32"), (state.final_obs, "f32"), (state.final_owner, "s32")):
            shape = ",".join(map(str, array.shape))
            written = set(re.findall(rf"= {kind}\[{shape}\]\S* ([\w-]+)\(", executable.as_text()))
            assert written, f"{shape} is not in the compiled text"
            in_place = {"dynamic-update-slice", "scatter", "fusion", "get-tuple-element", "parameter", "bitcast"}
            assert written <= in_place, written
        memory = executable.memory_analysis()
        held = sum(4 * int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(state))
        assert memory.alias_size_in_bytes == held  # the result is the donated argument
        scratch[capacity] = memory.temp_size_in_bytes
    assert scratch[1_000_000] == scratch[10_000] < 100_000
