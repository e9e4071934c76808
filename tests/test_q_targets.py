"""The conservative target: hand-worked numbers, the laws of the penalties, and its compiled program."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from sqt_jax import q_targets

SQRT2 = 2**0.5
PENALTIES = [q_targets.batch_std, q_targets.transition_std]
by_name = pytest.mark.parametrize("penalty", PENALTIES, ids=lambda penalty: penalty.__name__)

# Two critics, three transitions, the last one terminal: min [1, 0, 2], mean [2, 2, 2], half the distance [1, 2, 0].
REWARD = jnp.array([1.0, 2.0, 3.0])
DISCOUNT = jnp.array([1.0, 1.0, 0.0])
NEXT_Q = jnp.array([[1.0, 4.0, 2.0], [3.0, 0.0, 2.0]])


@pytest.fixture(autouse=True, scope="module")
def strict_promotion(strict_dtypes):
    with jax.numpy_rank_promotion("raise"):
        yield


def target(next_q=NEXT_Q, reward=REWARD, discount=DISCOUNT, gamma=0.5, **settings):
    return q_targets.td_target(reward, discount, next_q, gamma=gamma, **settings)


# Hand-worked numbers


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, [1.5, 2, 3]),
        ({"reduce": q_targets.mean_over_critics}, [2, 3, 3]),
        ({"reduce": partial(q_targets.min_over_subset, subset=jnp.array([1]))}, [2.5, 2, 3]),
        ({"gamma": 0.0}, [1, 2, 3]),
        ({"gamma": 1.0}, [2, 2, 3]),
        ({"entropy_term": jnp.array([0.2, -0.4, 1.0])}, [1.4, 2.2, 3]),
        ({"value_bounds": (0.5, 0.75)}, [1.375, 2.25, 3]),
        ({"penalty": partial(q_targets.batch_std, coef=0.5, ddof=0)}, [1.25, 1.75, 3]),
        ({"penalty": partial(q_targets.batch_std, coef=0.5)}, [1.5 - 0.25 * SQRT2, 2 - 0.25 * SQRT2, 3]),
        ({"penalty": partial(q_targets.transition_std, coef=0.5, ddof=0)}, [1.25, 1.5, 3]),
        ({"penalty": partial(q_targets.transition_std, coef=0.5)}, [1.5 - 0.25 * SQRT2, 2 - 0.5 * SQRT2, 3]),
        ({"penalty": lambda next_q: jnp.float32(7)}, [-2, -1.5, 3]),
    ],
)
def test_hand_worked_targets(maybe_jit, settings, expected):
    result = maybe_jit(lambda next_q: target(next_q, **settings))(NEXT_Q)
    np.testing.assert_allclose(result, expected, rtol=1e-6)
    assert result.shape == (3,) and result.dtype == jnp.float32


@pytest.mark.parametrize(
    ("penalty", "expected"),
    [
        (partial(q_targets.batch_std, coef=0.5, ddof=0), [1, 1.5, 2.5]),
        (partial(q_targets.transition_std, coef=0.5, ddof=0), [1, 1, 3]),
    ],
)
def test_a_penalty_outside_gamma_is_neither_discounted_nor_masked(maybe_jit, penalty, expected):
    result = maybe_jit(lambda next_q: target(next_q, penalty=penalty, penalty_inside_gamma=False))(NEXT_Q)
    np.testing.assert_allclose(result, expected, rtol=1e-6)


def test_the_bounds_clip_the_reduced_value_and_nothing_after_it(maybe_jit):
    penalty = partial(q_targets.transition_std, coef=0.5, ddof=0)  # [0.5, 1, 0]
    settings = {"value_bounds": (0.5, 1.5), "penalty": penalty, "entropy_term": jnp.array([1.0, -1.0, 0.0])}
    # min clipped: [1, 0.5, 1.5]; less the entropy term: [0, 1.5, 1.5]; less the penalty: [-0.5, 0.5, 1.5]
    result = maybe_jit(lambda next_q: target(next_q, **settings))(NEXT_Q)
    np.testing.assert_allclose(result, [0.75, 2.25, 3], rtol=1e-6)


def test_hand_worked_penalties(maybe_jit):
    def penalties(next_q):
        return {
            "none": q_targets.no_penalty(next_q),
            "sqt": q_targets.batch_std(next_q, coef=0.5, ddof=0),
            "tuple": q_targets.transition_std(next_q, coef=0.1, ddof=0),
            "torch": q_targets.std_over_critics(next_q),
        }

    result = maybe_jit(penalties)(NEXT_Q)
    np.testing.assert_allclose(result["none"], 0)
    np.testing.assert_allclose(result["sqt"], 0.5, rtol=1e-6)
    np.testing.assert_allclose(result["tuple"], [0.1, 0.2, 0], rtol=1e-6)
    np.testing.assert_allclose(result["torch"], [SQRT2, 2 * SQRT2, 0], rtol=1e-6)
    assert result["none"].shape == result["sqt"].shape == ()


def test_min_over_more_critics_is_maxmin(maybe_jit):
    next_q = jnp.array([[3.0, 1.0], [2.0, 5.0], [4.0, -1.0]])
    np.testing.assert_array_equal(maybe_jit(q_targets.min_over_critics)(next_q), [2, -1])
    np.testing.assert_array_equal(maybe_jit(q_targets.min_over_subset)(next_q, jnp.array([2, 0])), [3, -1])


def test_random_subsets_are_distinct_critics_and_equally_likely():
    keys = jax.random.split(jax.random.key(0), 3000)
    subsets = np.sort(jax.jit(jax.vmap(lambda key: q_targets.random_subset(key, 4, 2)))(keys), axis=1)
    pairs, counts = np.unique(subsets, axis=0, return_counts=True)
    assert pairs.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
    assert np.abs(counts - 500).max() < 5 * (500 * 5 / 6) ** 0.5  # five standard deviations


# Laws


def floats(low, high):
    return st.floats(low, high, width=32)


def critics_values(sizes=(2, 5)):
    """next_q [N, 4] with a few sizes N, so that few programs are compiled."""
    shapes = st.sampled_from([(n, 4) for n in sizes])
    return npst.arrays(np.float32, shapes, elements=floats(-100, 100))


coefs = floats(0.0625, 1)
ddofs = st.sampled_from([0, 1])


@partial(jax.jit, static_argnames=("penalty", "ddof", "inside"))
def compiled_target(next_q, coef, penalty=None, ddof=1, inside=True):
    """The target with reward 1, discount [1, 1, 1, 0] and gamma 0.99."""
    reward, discount = jnp.ones(4), jnp.array([1.0, 1.0, 1.0, 0.0])
    bound = q_targets.no_penalty if penalty is None else partial(penalty, coef=coef, ddof=ddof)
    return q_targets.td_target(reward, discount, next_q, gamma=0.99, penalty=bound, penalty_inside_gamma=inside)


@partial(jax.jit, static_argnames=("penalty", "ddof"))
def compiled_penalty(penalty, next_q, coef, ddof=1):
    return penalty(next_q, coef=coef, ddof=ddof)


@by_name
@given(next_q=critics_values(), ddof=ddofs, inside=st.booleans())
def test_coefficient_zero_is_the_baselines_target_bit_for_bit(penalty, next_q, ddof, inside):
    plain = compiled_target(next_q, 0.0)
    ours = compiled_target(next_q, 0.0, penalty=penalty, ddof=ddof, inside=inside)
    np.testing.assert_array_equal(np.asarray(ours).view(np.uint32), np.asarray(plain).view(np.uint32))


@by_name
@given(next_q=critics_values(), coef=coefs, ddof=ddofs, inside=st.booleans())
def test_a_positive_coefficient_lowers_the_target(penalty, next_q, coef, ddof, inside):
    next_q[0] = next_q[1:].max(axis=0) + 1  # the critics disagree about every transition
    plain = compiled_target(next_q, 0.0)
    ours = compiled_target(next_q, coef, penalty=penalty, ddof=ddof, inside=inside)
    subject = slice(None) if not inside else slice(3)  # inside gamma, the terminal transition has no penalty
    assert np.all(np.asarray(ours)[subject] < np.asarray(plain)[subject])
    if inside:
        assert ours[3] == plain[3] == 1


@given(next_q=critics_values(sizes=[2]))
def test_two_critics_min_is_mean_minus_std(next_q):
    std = compiled_penalty(q_targets.transition_std, next_q, 1.0, ddof=0)
    mean, least = q_targets.mean_over_critics(next_q), q_targets.min_over_critics(next_q)
    np.testing.assert_allclose(least, mean - std, atol=1e-4)


@by_name
@given(next_q=critics_values(), shift=floats(-100, 100), coef=coefs, ddof=ddofs)
def test_a_shift_of_all_values_leaves_the_penalty(penalty, next_q, shift, coef, ddof):
    before = compiled_penalty(penalty, next_q, coef, ddof=ddof)
    np.testing.assert_allclose(compiled_penalty(penalty, next_q + shift, coef, ddof=ddof), before, atol=1e-4)


@by_name
@given(next_q=critics_values(), scale=floats(-8, 8), coef=coefs, ddof=ddofs)
def test_a_scaling_of_all_values_scales_the_penalty_by_its_size(penalty, next_q, scale, coef, ddof):
    before = compiled_penalty(penalty, next_q, coef, ddof=ddof)
    after = compiled_penalty(penalty, scale * next_q, coef, ddof=ddof)
    np.testing.assert_allclose(after, abs(scale) * before, rtol=1e-4, atol=1e-3)


@by_name
@given(next_q=critics_values(), coef=coefs, ddof=ddofs, data=st.data())
def test_the_order_of_the_critics_does_not_matter(penalty, next_q, coef, ddof, data):
    order = data.draw(st.permutations(range(len(next_q))))
    before = compiled_target(next_q, coef, penalty=penalty, ddof=ddof)
    np.testing.assert_allclose(compiled_target(next_q[order], coef, penalty=penalty, ddof=ddof), before, atol=1e-4)


@given(next_q=critics_values(), coef=coefs, ddof=ddofs)
def test_the_batch_penalty_is_the_mean_of_the_transition_penalty(next_q, coef, ddof):
    each = compiled_penalty(q_targets.transition_std, next_q, coef, ddof=ddof)
    assert each.shape == (4,)
    np.testing.assert_allclose(
        compiled_penalty(q_targets.batch_std, next_q, coef, ddof=ddof), jnp.mean(each), rtol=1e-5, atol=1e-6
    )


@by_name
@given(next_q=critics_values(), coef=coefs, ddof=ddofs)
def test_the_penalty_is_numpys_std(penalty, next_q, coef, ddof):
    std = np.std(next_q.astype(np.float64), axis=0, ddof=ddof)
    expected = coef * (std.mean() if penalty is q_targets.batch_std else std)
    np.testing.assert_allclose(compiled_penalty(penalty, next_q, coef, ddof=ddof), expected, rtol=1e-4, atol=1e-4)


@by_name
def test_the_penalty_of_agreeing_critics_is_zero(penalty):
    np.testing.assert_array_equal(penalty(jnp.full((5, 3), 7.0), coef=1.0), 0)


@by_name
def test_a_penalty_of_one_critic_is_rejected(penalty):
    with pytest.raises(ValueError, match="at least 2 critics"):
        penalty(jnp.ones((1, 4)), coef=0.5, ddof=0)


@by_name
@pytest.mark.parametrize(("n", "ddof"), [(2, 2), (2, 3), (5, 5), (2, -1)])
def test_ddof_must_be_below_the_number_of_critics(penalty, n, ddof):
    with pytest.raises(ValueError, match=f"below the number of critics .{n}."):
        penalty(jnp.ones((n, 4)), coef=0.5, ddof=ddof)


@by_name
def test_nothing_is_differentiated_through_the_target(penalty):
    def total(next_q, reward, entropy, coef):
        bound = partial(penalty, coef=coef)
        return jnp.sum(target(next_q, reward, penalty=bound, entropy_term=entropy))

    grads = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(NEXT_Q, REWARD, jnp.ones(3), jnp.float32(0.5))
    for grad in grads:
        np.testing.assert_array_equal(grad, 0)  # also not NaN where critics agree, as the third transition's do


@pytest.mark.parametrize("inside", [True, False])
def test_a_split_batch_has_the_complete_batchs_penalty(inside):
    key = jax.random.key(0)
    next_q, reward, discount = jax.random.normal(key, (3, 8)), jnp.arange(8.0), jnp.ones(8)

    def ours(next_q, reward, discount, axis_name=None):
        penalty = partial(q_targets.batch_std, coef=0.5, axis_name=axis_name)
        return target(next_q, reward, discount, penalty=penalty, penalty_inside_gamma=inside)

    halves = next_q.reshape(3, 2, 4).swapaxes(0, 1), reward.reshape(2, 4), discount.reshape(2, 4)
    split = jax.jit(jax.vmap(partial(ours, axis_name="devices"), axis_name="devices"))(*halves)
    complete = ours(next_q, reward, discount)
    np.testing.assert_allclose(split.reshape(8), complete, rtol=1e-6)
    alone = jax.jit(jax.vmap(ours))(*halves)  # without the mean over devices, each half has a penalty of its own
    assert np.abs(alone.reshape(8) - complete).max() > 1e-3


# Rejected


@pytest.mark.parametrize(
    "shapes",
    [
        {"reward": (3, 1)},  # would broadcast to a target of [B, B]
        {"discount": (3, 1)},
        {"next_q": (3,)},  # one critic: the minimum would be over the batch
        {"next_q": (2, 4)},
        {"entropy_term": (3, 1)},
        {"next_q": (2,), "reward": (), "discount": ()},  # one transition at a time: SQT's penalty needs the batch
    ],
    ids=str,
)
def test_shapes_that_would_broadcast_silently_are_rejected(maybe_jit, shapes):
    shapes = {"next_q": (2, 3), "reward": (3,), "discount": (3,), "entropy_term": (3,)} | shapes
    values = {name: jnp.ones(shape) for name, shape in shapes.items()}
    rejected = r"\[N, B\], \[B\] and \[B\], not|have to leave \(3,\) of the values, not \(3, 3\)"
    with jax.numpy_rank_promotion("allow"), pytest.raises(ValueError, match=rejected):  # JAX's default
        maybe_jit(lambda values: q_targets.td_target(**values, gamma=0.9))(values)


@pytest.mark.parametrize("size", [0, 3])
def test_a_subset_of_too_many_critics_is_rejected(size):
    with pytest.raises(ValueError, match=f"expected a subset of 1 to 2 critics, not {size}"):
        q_targets.random_subset(jax.random.key(0), 2, size)


# Compiled


@pytest.mark.parametrize("penalty", [None, *PENALTIES], ids=lambda p: getattr(p, "__name__", "plain"))
def test_the_target_compiles_to_a_few_fused_kernels_without_copies(penalty):
    def complete(next_q, reward, discount, coef, gamma):
        bound = q_targets.no_penalty if penalty is None else partial(penalty, coef=coef)
        return target(next_q, reward, discount, gamma, penalty=bound)

    shapes = [(2, 256), (256,), (256,), (), ()]
    arguments = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    # As users compile it: the tests' own flags (conftest) split a reduction.
    text = jax.jit(complete).lower(*arguments).compile({"xla_cpu_use_fusion_emitters": True}).as_text()
    entry = text[text.index("\nENTRY ") :]
    operations = re.findall(r"^\s+(?:ROOT )?%\S+ = \S+ ([\w-]+)\(", entry, flags=re.MULTILINE)
    kernels = [op for op in operations if op not in ("parameter", "constant", "bitcast", "tuple")]
    assert 1 <= len(kernels) <= 5, operations
    assert not re.search(r"\bcopy(-start)?\(", text)
    if jax.default_backend() == "cpu":
        assert set(kernels) <= {"fusion", "reduce"}, operations


@pytest.mark.parametrize(("reduce", "expected"), [("mean", [2, 3.5]), ("min", [1, 2]), ("first", [3, 2])])
def test_reductions_that_the_actor_maximises(maybe_jit, reduce, expected):
    q = jnp.array([[3.0, 2.0], [1.0, 5.0]])
    np.testing.assert_allclose(maybe_jit(lambda q: q_targets.ACTOR_REDUCTIONS[reduce](q))(q), expected)
