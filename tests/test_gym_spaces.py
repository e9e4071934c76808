"""Gymnasium's spaces: vectors of observations by hand, and the laws of scaled actions."""

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sqt_jax.envs import gym_spaces

pytestmark = pytest.mark.filterwarnings("error")


IMAGE = spaces.Box(0, 255, (2, 2, 1), np.uint8)
MIXED = spaces.Dict({"b": spaces.Discrete(3, start=5), "a": spaces.Tuple((IMAGE, spaces.Box(-1, 1, ())))})


@pytest.mark.parametrize(
    ("space", "obs", "vector"),
    [
        (spaces.Box(-np.inf, np.inf, (3,)), np.float32([1, -2, 0.5]), [1, -2, 0.5]),
        (spaces.Box(-1, 1, (2, 2), np.float64), np.array([[0.1, 0.2], [0.3, 0.4]]), [0.1, 0.2, 0.3, 0.4]),
        (spaces.Box(-1, 1, ()), np.array(0.5, np.float32), [0.5]),
        (IMAGE, np.array([[[0], [1]], [[128], [255]]], np.uint8), [0, 1, 128, 255]),
        (spaces.Discrete(3, start=5), 6, [0, 1, 0]),
        (spaces.MultiDiscrete([2, 3]), np.array([1, 0]), [0, 1, 1, 0, 0]),
        (spaces.MultiBinary(3), np.array([1, 0, 1], np.int8), [1, 0, 1]),
        (MIXED, {"a": (np.full((2, 2, 1), 7, np.uint8), np.array(-1, np.float32)), "b": 7}, [7, 7, 7, 7, -1, 0, 0, 1]),
    ],
    ids=["box", "matrix", "number", "image", "discrete", "multidiscrete", "multibinary", "dict"],
)
def test_observations_become_vectors(space, obs, vector):
    found = gym_spaces.observations(space)
    assert found.size == len(vector) and space.contains(obs)
    flat = found.flatten(obs)
    assert flat.dtype == np.float32
    np.testing.assert_array_equal(flat, np.float32(vector))


@pytest.mark.parametrize(
    "space",
    [
        spaces.Text(5),
        spaces.Sequence(spaces.Discrete(2)),
        spaces.Graph(spaces.Box(-1, 1, (2,)), None),
        spaces.OneOf((spaces.Discrete(2), spaces.Discrete(3))),
        spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Tuple((spaces.Text(5),))}),
        spaces.Box(-1, 1, (0,)),
    ],
    ids=lambda space: type(space).__name__,
)
def test_other_observation_spaces_are_rejected_by_name(space):
    with pytest.raises(ValueError, match="observation space: expects Box, .*, not ") as error:
        gym_spaces.observations(space)
    assert str(space) in str(error.value)


def test_an_observation_of_another_size_is_rejected():
    flatten = gym_spaces.observations(spaces.Box(-1, 1, (3,))).flatten
    with pytest.raises(ValueError, match=r"observation: expects 3 numbers for Box\(.*\), not 2"):
        flatten(np.zeros(2))


@pytest.mark.parametrize(
    ("space", "action", "element"),
    [
        (spaces.Box(np.float32([0, -2]), np.float32([10, 4])), [0.5, -0.5], [7.5, -0.5]),
        (spaces.Box(-3, 1, (2, 1), np.float64), [0, 2], [[-1], [1]]),  # beyond: clipped
        (spaces.Box(0, 255, (3,), np.uint8), [-1, 0.1, np.inf], [0, 140, 255]),  # 140.25
        (spaces.Box(-1, 1, (2,), np.int8), [0.49, 0.51], [0, 1]),
        (spaces.Box(0, 1, (2,), bool), [-0.1, 0.1], [False, True]),
        (spaces.Box(2, 2, ()), [0.3], 2),
        (spaces.Box(-3e38, 3e38, (2,)), [0.5, -1], [1.5e38, -3e38]),
        (spaces.Box(-1.7e308, 1.7e308, (1,), np.float64), [[-0.5], [1]], [[-0.85e308], [1.7e308]]),  # a batch
    ],
)
def test_actions_are_scaled_to_the_box(space, action, element):
    found = gym_spaces.actions(space).scale(np.float32(action))
    assert isinstance(found, np.ndarray) and found.dtype == space.dtype and found.shape == np.shape(element)
    np.testing.assert_allclose(found, np.asarray(element, space.dtype), rtol=1e-6)


DTYPES = ["float16", "float32", "float64", "bool", "int8", "uint8", "int64", "uint64"]


@st.composite
def boxes(draw):
    dtype, shape = (
        np.dtype(draw(st.sampled_from(DTYPES))),
        draw(arrays.array_shapes(min_dims=0, max_dims=2, max_side=2)),
    )
    elements = arrays.from_dtype(dtype, allow_nan=False, allow_infinity=False)
    one, other = (draw(arrays.arrays(dtype, shape, elements=elements)) for _ in range(2))
    return spaces.Box(np.asarray(np.minimum(one, other)), np.asarray(np.maximum(one, other)), dtype=dtype)


@given(space=boxes(), numbers=st.lists(st.floats(-1, 1) | st.floats(-1, 1, width=32), min_size=1, max_size=8))
def test_a_scaled_action_is_in_the_box_and_increases_from_bound_to_bound(space, numbers):
    scaled = gym_spaces.actions(space)
    ordered = np.sort([-1.0, *numbers, 1.0])
    elements = scaled.scale(np.repeat(ordered[:, None], scaled.size, axis=1))
    assert all(space.contains(np.asarray(element)) for element in elements)
    assert (elements[:-1] <= elements[1:]).all()
    np.testing.assert_array_equal(elements[0], space.low)
    np.testing.assert_array_equal(elements[-1], space.high)


def test_bounds_that_other_formulas_leave():
    space = spaces.Box(np.float32([-1.8151915073394775]), np.float32([1.259085774421692]))
    assert space.low + (space.high - space.low) > space.high  # an ulp above
    assert space.contains(gym_spaces.actions(space).scale([1.0]))


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-np.inf, np.inf, (2,)),
        spaces.Box(np.float32([0, -np.inf]), np.float32([1, 1])),
        spaces.Box(-np.inf, 5, (1,), np.int64),
        spaces.Box(-1, 1, (0,)),
        spaces.Discrete(3),
        spaces.Dict({"a": spaces.Box(-1, 1, (1,))}),
    ],
)
def test_actions_without_a_bounded_box_are_rejected_by_name(space):
    with pytest.raises(ValueError, match="^action space: expects a Box with bounds, not ") as error:
        gym_spaces.actions(space)
    assert str(error.value).endswith(" ".join(str(space).split()))


def test_the_name_of_a_large_space_is_one_short_line():
    space = spaces.Box(-np.inf, np.arange(600.0), dtype=np.float64)
    assert str(space).count("\n") > 10
    with pytest.raises(ValueError) as error:
        gym_spaces.actions(space)
    assert "\n" not in str(error.value) and 100 < len(str(error.value)) < 260


@pytest.mark.parametrize("shape", [(), (2,), (3, 1), (0,)])
def test_an_action_of_another_size_is_rejected(shape):
    scale = gym_spaces.actions(spaces.Box(-1, 1, (3,))).scale
    with pytest.raises(ValueError, match=r"action: expects \[..., 3\] for Box\(.*\), not \["):
        scale(np.zeros(shape))


def test_an_action_that_is_nan_is_rejected():
    with pytest.raises(ValueError, match=r"action: expects numbers in \[-1, 1\], not \[ 0. nan\]"):
        gym_spaces.actions(spaces.Box(-1, 1, (2,))).scale([0, np.nan])
