"""The members of a sweep: which leaves of a state each has its own of, and how they lie along devices.

Members never exchange anything. On several devices each one runs the same compiled program over its share of them
(`jax.shard_map` over a mesh of one axis), with its own loops and branches; shares are equal, so that a sweep whose
size is no multiple of the number of devices holds copies of its first members at its end, which nobody asks for.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from sqt_jax.types import State

AXIS = "members"
# Leaves that are equal in all members, which advance in lockstep.
SHARED_LEAVES = frozenset({"env_steps", "gradient_steps", "inserted"})


def member_axes(state: State) -> Any:
    """For each leaf of a state: 0 where members have their own, None where they share it."""

    def axis(path, _):
        name = getattr(path[-1], "name", None)
        return None if name in SHARED_LEAVES else 0

    return jax.tree_util.tree_map_with_path(axis, state)


class Layout(NamedTuple):
    """S members along some devices.

    The devices may be those of several hosts (`jax.distributed`): then every process calls the sweep's functions with
    the same arguments, and sees those members that lie on its own devices.
    """

    members: int
    devices: tuple[jax.Device, ...] = ()  # none: the default one

    @property
    def spread(self) -> bool:
        return len(self.devices) > 1

    @property
    def held(self) -> int:
        """S and the copies that fill the last device's share."""
        return len(self.devices) * math.ceil(self.members / len(self.devices)) if self.spread else self.members

    @property
    def mesh(self) -> Mesh:
        return Mesh(np.asarray(self.devices), (AXIS,))

    def specs(self, axes: Any) -> Any:
        """Of a tree of `vmap`'s axes."""
        spec = {None: PartitionSpec(), 0: PartitionSpec(AXIS)}
        return jax.tree.map(spec.__getitem__, axes, is_leaf=lambda axis: axis is None)

    def sharding(self, axis: int | None) -> NamedSharding | None:
        """Of a leaf with this axis of members; None is the default device."""
        return NamedSharding(self.mesh, self.specs(axis)) if self.spread else None

    def over_members(self, function: Callable, in_axes: tuple, out_axes: Any) -> Callable:
        """`jax.vmap` of a function of one member, on the devices."""
        mapped = jax.vmap(function, in_axes, out_axes)
        if not self.spread:
            return mapped
        specs = {"in_specs": self.specs(in_axes), "out_specs": self.specs(out_axes)}
        # Leaves that members share are computed alike on every device, which the check could not know.
        return jax.shard_map(mapped, mesh=self.mesh, **specs, check_vma=False)

    def filled(self, leaf: Any) -> Any:
        """[S, ...] -> [held, ...]"""
        return leaf if self.held == self.members else leaf[np.arange(self.held) % self.members]


def usable_devices(members: int) -> int:
    """How many of this process's devices a sweep is spread over by itself: as many as give each the smallest share.

    With more, some would hold copies alone.
    """
    here = len(jax.local_devices())
    return math.ceil(members / math.ceil(members / here))


def layout_here(members: int) -> Layout:
    """A sweep on the devices that it expects by itself."""
    return Layout(members, tuple(jax.local_devices()[: usable_devices(members)]))
