"""Gymnasium's spaces for a policy: observations become vectors, its actions in [-1, 1] elements of a box."""

import textwrap
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.spaces import utils


class Observations(NamedTuple):
    """The elements of an observation space as vectors."""

    size: int  # O
    flatten: Callable[[Any], np.ndarray]  # element -> [O] float32. Raises ValueError for another number of numbers.


class Actions(NamedTuple):
    """The elements of a box by actions in [-1, 1]."""

    size: int  # A
    # Action [..., A] -> elements [..., *shape of the box]. Raises ValueError for other shapes and for NaN.
    scale: Callable[[Any], np.ndarray]


def observations(space: spaces.Space) -> Observations:
    """The vectors of an observation space, in the order of `gymnasium.spaces.utils.flatten`.

    Box and MultiBinary keep their numbers (images too), Discrete and MultiDiscrete become one-hot, Dict and Tuple the
    concatenation of their parts.

    Raises:
      ValueError: the space has another part (Text, Sequence, Graph, OneOf, ...), or no numbers.
    """
    size = utils.flatdim(space) if _consists_of_numbers(space) else 0
    if not size:
        kinds = "Box, Discrete, MultiDiscrete, MultiBinary, or Dict and Tuple of them"
        raise ValueError(f"observation space: expects {kinds}, not {_line(space)}")

    def flatten(obs: Any) -> np.ndarray:
        vector = np.asarray(utils.flatten(space, obs), np.float32)
        if vector.shape != (size,):
            raise ValueError(f"observation: expects {size} numbers for {_line(space)}, not {vector.size}")
        return vector

    return Observations(size=size, flatten=flatten)


def actions(space: spaces.Space) -> Actions:
    """The elements of a bounded box, of any shape, dtype and bounds.

    -1 is exactly the lower bound, 1 the upper one, and actions beyond are clipped. Boxes of integers get the nearest
    integer. The result is an element of the box: no rounding leaves its bounds, and bounds as large as the dtype allows
    do not overflow. NaN is an error: any replacement would hide that the policy is broken.

    Raises:
      ValueError: the space is no Box, has a side without a bound, or no numbers.
    """
    if not isinstance(space, spaces.Box) or not space.is_bounded() or space.low.size == 0:
        raise ValueError(f"action space: expects a Box with bounds, not {_line(space)}")
    size, is_integer = space.low.size, space.dtype.kind != "f"
    low, high = space.low.ravel(), space.high.ravel()
    wide = np.result_type(space.dtype, np.float64)
    wide_low, wide_high = low.astype(wide), high.astype(wide)
    middle, half = wide_low / 2 + wide_high / 2, wide_high / 2 - wide_low / 2  # the sum or the width could overflow

    def scale(action: Any) -> np.ndarray:
        action = np.asarray(action, wide)
        if action.shape[-1:] != (size,):
            raise ValueError(f"action: expects [..., {size}] for {_line(space)}, not {list(action.shape)}")
        if np.isnan(action).any():
            raise ValueError(f"action: expects numbers in [-1, 1], not {_line(action)}")
        with np.errstate(over="ignore"):  # of the last rounding; infinity then becomes the bound
            value = middle + np.clip(action, -1, 1) * half
        value = np.rint(value) if is_integer else value
        at_low, at_high = (action <= -1) | (value <= wide_low), (action >= 1) | (value >= wide_high)
        # Bounds beyond 2^53 are not exact in `wide`: only numbers between them are converted.
        between = np.where(at_low | at_high, 0, value).astype(space.dtype)
        return np.select([at_low, at_high], [low, high], between).reshape(action.shape[:-1] + space.shape)

    return Actions(size=size, scale=scale)


def _consists_of_numbers(space: spaces.Space) -> bool:
    if isinstance(space, spaces.Dict):
        return all(map(_consists_of_numbers, space.spaces.values()))
    if isinstance(space, spaces.Tuple):
        return all(map(_consists_of_numbers, space.spaces))
    return isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary)


def _line(value: Any) -> str:
    """The text of a space or an array on one line, cut off where it is long."""
    return textwrap.shorten(str(value), 200, placeholder=" ...")
