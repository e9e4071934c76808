"""Spreads the members of a sweep over devices.

Members never exchange anything. Each device runs the same compiled program on its share of them (`jax.shard_map` over a
mesh of one axis), with its own loops and branches. Shares are equal: a sweep whose size is not a multiple of the number
of devices is padded with copies of its first members, which are ignored.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from sqt_jax.types import Array, State

AXIS = "members"


def every_leaf(axes: Any, state: State) -> Any:
    """A prefix tree of `vmap` axes (0: each member has its own, None: members share it), spread over all leaves."""
    return jax.tree.map(lambda axis, part: jax.tree.map(lambda _: axis, part), axes, state, is_leaf=_is_axis)


def _is_axis(axis: Any) -> bool:
    return axis is None or axis == 0


class Layout(NamedTuple):
    """S members, and the devices that they are spread over.

    The devices may belong to several hosts (`jax.distributed`): then every process calls the sweep's functions with
    the same arguments and sees the members on its own devices.
    """

    members: int
    devices: tuple[jax.Device, ...] = ()  # empty: the default device

    @property
    def spread(self) -> bool:
        """Whether there are several devices."""
        return len(self.devices) > 1

    @property
    def padded_size(self) -> int:
        """S plus the padding that makes the devices' shares equal."""
        return len(self.devices) * math.ceil(self.members / len(self.devices)) if self.spread else self.members

    @property
    def mesh(self) -> Mesh:
        """The devices as a mesh of one axis."""
        return Mesh(np.asarray(self.devices), (AXIS,))

    def specs(self, axes: Any) -> Any:
        """The partition of a tree of `vmap` axes."""
        spec = {None: PartitionSpec(), 0: PartitionSpec(AXIS)}
        return jax.tree.map(spec.__getitem__, axes, is_leaf=lambda axis: axis is None)

    def sharding(self, axis: int | None) -> NamedSharding | None:
        """The sharding of a leaf with this axis of members; None is the default device."""
        return NamedSharding(self.mesh, self.specs(axis)) if self.spread else None

    def over_members(self, function: Callable, in_axes: tuple, out_axes: Any) -> Callable:
        """`jax.vmap` of a function of one member, on the devices."""
        mapped = jax.vmap(function, in_axes, out_axes)
        if not self.spread:
            return mapped
        specs = {"in_specs": self.specs(in_axes), "out_specs": self.specs(out_axes)}
        # Every device computes the leaves that members share in the same way; the check cannot see that.
        return jax.shard_map(mapped, mesh=self.mesh, **specs, check_vma=False)

    def padded(self, leaf: Any) -> Any:
        """[S, ...] -> [padded_size, ...], with copies of the first members"""
        return leaf if self.padded_size == self.members else leaf[np.arange(self.padded_size) % self.members]


def device_index() -> Array:
    """The number of this device among those of a `Layout`: [] int32; 0 in a program for one device."""
    try:
        return jax.lax.axis_index(AXIS)
    except NameError:  # the axis does not exist
        return jnp.zeros((), jnp.int32)


def usable_devices(members: int) -> int:
    """The number of devices that a sweep uses by default: the fewest of this process that make shares smallest."""
    here = len(jax.local_devices())
    return math.ceil(members / math.ceil(members / here))


def layout_here(members: int) -> Layout:
    """A sweep on its default devices."""
    return Layout(members, tuple(jax.local_devices()[: usable_devices(members)]))
