"""Where the members of a population lie: on one device, or spread over a mesh of several.

Every device runs the program of its own members, and none of them hears of another's: members are
independent, so there is nothing to exchange. On one device the functions here hand back what they
are given.

Axis letters: P population member, D device.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

Tree = TypeVar("Tree")

Choice = int | Literal["all"]
"""How many devices to use."""

AXIS = "members"
"""The mesh's one axis, along which P is divided."""


@dataclass(frozen=True)
class Placement:
    """The members of a population, each on one device.

    All devices hold equally many. Where D does not divide P, the last one's are made up with
    padding: copies of a member, which are never healthy and so never trained, whose simulators
    rest, and which nothing outside of a program sees.

    Attributes:
      members: P.
      devices: the D that hold members.
      available: how many devices there are.
    """

    members: int
    devices: tuple[jax.Device, ...]
    available: int

    @property
    def count(self) -> int:
        """D."""
        return len(self.devices)

    @property
    def each(self) -> int:
        """Members on one device, padding included."""
        return -(-self.members // self.count)

    @property
    def padded(self) -> int:
        """Members on all devices, padding included."""
        return self.each * self.count

    @property
    def mesh(self) -> Mesh | None:
        """The mesh; None on one device."""
        return None if self.count == 1 else Mesh(np.array(self.devices), (AXIS,))

    def sharding(self, axis: int = 0) -> NamedSharding | None:
        """How an array whose members lie along `axis` is spread; None on one device."""
        mesh = self.mesh
        return None if mesh is None else NamedSharding(mesh, _divided(axis))

    def spread(self, tree: Tree, axis: int = 0) -> Tree:
        """A tree of P members (along `axis` of each leaf), on the devices and with padding.

        Each device is sent its own members and no others.
        """
        sharding = self.sharding(axis)
        if sharding is None:
            return tree

        def one(leaf):
            leaf = np.asarray(leaf)
            shape = list(leaf.shape)
            shape[axis] = self.padded

            def part(index):
                rows = leaf[index]
                missing = self.each - rows.shape[axis]
                if not missing:
                    return rows
                return np.concatenate([rows, np.repeat(rows.take([0], axis), missing, axis)], axis)

            return jax.make_array_from_callback(tuple(shape), sharding, part)

        return jax.tree.map(one, tree)

    def own(self, tree: Tree) -> Tree:
        """The P members of a tree that was spread, as NumPy arrays; as it is on one device."""
        if self.mesh is None:
            return tree
        return jax.tree.map(lambda leaf: np.asarray(leaf)[: self.members], tree)

    def own_shapes(self, tree: Tree) -> Tree:
        """The shapes of `own`'s result, for a tree that fits them; as it is on one device."""
        if self.mesh is None:
            return tree
        return jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((self.members, *x.shape[1:]), x.dtype), tree
        )

    def without_padding(self, chosen: jax.Array) -> jax.Array:
        """A mask of members, bool [P with padding], False for what is padding."""
        if self.padded == self.members:
            return chosen
        return chosen & jax.device_put(np.arange(self.padded) < self.members, self.sharding())

    def numbers(self) -> jax.Array | None:
        """The members' numbers, int32 [P with padding]; None on one device."""
        if self.mesh is None:
            return None
        return jax.device_put(np.arange(self.padded, dtype=np.int32), self.sharding())

    def over_devices(
        self,
        function: Callable,
        axes: Sequence[int | None],
        donate: Sequence[int] = (),
        compiler_options: Mapping[str, Any] | None = None,
    ) -> Callable:
        """A function of members as one of all members, each device doing its own.

        Args:
          function: of trees of any number of members; its results have them along axis 0.
          axes: for each argument the axis of members; None for what is the same for all.
          donate: the arguments whose memory is reused.
          compiler_options: of the jitted function.

        Returns:
          The function itself on one device; else a jitted one.
        """
        mesh = self.mesh
        if mesh is None:
            return function
        mapped = jax.shard_map(
            function,
            mesh=mesh,
            in_specs=tuple(PartitionSpec() if x is None else _divided(x) for x in axes),
            out_specs=_divided(0),
            check_vma=False,
        )
        options = None if compiler_options is None else dict(compiler_options)
        return jax.jit(mapped, donate_argnums=tuple(donate), compiler_options=options)

    def __str__(self) -> str:
        devices = f"{self.count} device{'s' if self.count > 1 else ''}"
        if self.count < self.available:
            devices = f"{self.count} of {self.available} devices"
        members = f"{self.members} member{'s' if self.members > 1 else ''}"
        if self.count == 1:
            return f"{members} on {devices}"
        most = "at most " if self.padded > self.members else ""
        return f"{members} on {devices}, {most}{self.each} on each"


def _divided(axis: int) -> PartitionSpec:
    return PartitionSpec(*[None] * axis, AXIS)


def check_devices(choice: Choice) -> int:
    """How many devices a choice means.

    Raises:
      ValueError: it is not a whole number above 0, or there are not so many.
    """
    there = len(jax.local_devices())
    if choice == "all":
        return there
    if isinstance(choice, bool) or not isinstance(choice, int) or choice < 1:
        raise ValueError(
            f"devices is {choice!r}, expected a whole number in [1 to {there}], or all"
        )
    if choice > there:
        kind = jax.local_devices()[0].platform
        raise ValueError(
            f"{choice} devices were asked for, and this machine has {there} ({kind}): "
            f"expected a whole number in [1 to {there}], or all"
        )
    return choice


def place(members: int, choice: Choice = "all") -> Placement:
    """Spreads members over devices: as few to a device as can be, on no more devices than needed.

    Args:
      members: P.
      choice: how many devices there may be.

    Raises:
      ValueError: see `check_devices`.
    """
    most = min(check_devices(choice), members)
    each = -(-members // most)
    devices = jax.local_devices()
    # Of 9 members on 8 devices one has 2: then 5 devices do as well, with less padding.
    return Placement(members, tuple(devices[: -(-members // each)]), len(devices))


def on_one_device(members: int) -> Placement:
    """All members on the default device."""
    return place(members, 1)
