"""Where the links of a tree are, and how they move: for many states at once, in few operations.

Brax computes the same joint by joint from quaternions, in thousands of operations on a few numbers
each, which take longer to compile than to run. Here the frame of every joint is the frame before it
times one 4 x 4 matrix, A + B sin(q) + C cos(q) + D q with constant A to D, and what depends on the
tree is a product with a matrix of zeros and ones.

n states, L links, N nodes (joints: axes one by one, but a free joint as one), D degrees of freedom,
Q joint positions.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

# Accelerators would take less than float32 for products otherwise.
einsum = functools.partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)


class Places(NamedTuple):
    """Where things are.

    Attributes:
      positions: of links, float32 [n, L, 3].
      quaternions: of links, float32 [n, L, 4].
      rotations: of links, float32 [n, L, 3, 3].
      axes: of degrees of freedom, float32 [n, D, 3]: what one unit of velocity turns about.
      slides: float32 [n, D, 3]: along what it moves.
      anchors: float32 [n, D, 3]: a point on each axis.
    """

    positions: jax.Array
    quaternions: jax.Array
    rotations: jax.Array
    axes: jax.Array
    slides: jax.Array
    anchors: jax.Array


class Motions(NamedTuple):
    """Inertia and motion about the centre of mass of the whole.

    Attributes:
      centre: float32 [n, 3].
      moments: of links, float32 [n, L, 3]: mass times the centre of mass's place.
      inertia: of links, float32 [n, L, 3, 3].
      turns, moves: of degrees of freedom, float32 [n, D, 3]: the angular and linear part of what
        one unit of velocity does.
      link_turns, link_moves: of links, float32 [n, L, 3]: their velocity.
      turns_rate, moves_rate: how turns and moves change, float32 [n, D, 3].
    """

    centre: jax.Array
    moments: jax.Array
    inertia: jax.Array
    turns: jax.Array
    moves: jax.Array
    link_turns: jax.Array
    link_moves: jax.Array
    turns_rate: jax.Array
    moves_rate: jax.Array


class Chain:
    """The tree of a system whose joints are hinges, slides and at most one free joint at its root.

    Attributes:
      mass: of links, float32 [L].
      moved_by: float32 [L, D], 1 where a degree of freedom moves a link.
      below: float32 [D, D], 1 where the second of two degrees of freedom comes before the first, or
        is it, on the way from the root.
      dof_links: int [D], the link of each degree of freedom.

    Args:
      system: a `brax.System`.

    Raises:
      ValueError: the system is not of that kind.
    """

    def __init__(self, system):
        kinds, self._parents = system.link_types, [int(p) for p in system.link_parents]
        joint, transform = system.link.joint, system.link.transform
        free = kinds[0] == "f"
        if (
            self._parents.count(-1) != 1
            or "f" in kinds[1:]
            or not np.allclose(joint.rot, [1, 0, 0, 0])
            or system.enable_fluid
            or (free and (np.any(transform.pos[0]) or np.any(joint.pos[0])))
            or any(
                kind in "23f" and (parent >= 0 or not np.allclose(rotation, [1, 0, 0, 0]))
                for kind, parent, rotation in zip(kinds, self._parents, transform.rot, strict=True)
            )
        ):
            raise ValueError(
                f"a tree of links {kinds} with parents {self._parents} was given, expected one "
                "root, free or with several axes, and hinges and slides of one axis each after it"
            )
        self._free = free
        self._nodes(system)
        self._levels()
        self._masks()
        inertia = system.link.inertia
        self.mass = np.asarray(inertia.mass, np.float32)
        self._centres = np.asarray(inertia.transform.pos, np.float32)
        turned = np.array([rotation_of(q) for q in np.asarray(inertia.transform.rot)])
        self._inertia = np.asarray(
            turned @ np.asarray(inertia.i) @ turned.swapaxes(1, 2), np.float32
        )

    def _nodes(self, system) -> None:
        """Each node's predecessor, what links and degrees of freedom it serves, and its matrices.

        Halves: [.., 0, :, :] are frames, [.., 1, :, :] multiply quaternions from the left.
        """
        link, motion = system.link, system.dof.motion
        angular, linear = np.asarray(motion.ang), np.asarray(motion.vel)
        before: list[int] = []
        matrices: list[np.ndarray] = []
        last: list[int] = []
        node_of_dof: list[int] = []
        dof_link: list[int] = []
        offsets: list[np.ndarray] = []
        for number, (kind, parent) in enumerate(zip(system.link_types, self._parents, strict=True)):
            place = np.asarray(link.joint.pos[number], np.float64)
            transform = [
                _frame(np.asarray(link.transform.pos[number]), link.transform.rot[number]),
                _left(link.transform.rot[number]),
            ]
            fixed = np.stack([transform[0] @ _frame(place), transform[1]])
            offsets.append(fixed[0, :3, 3].copy())
            if parent >= 0:
                back = _frame(-np.asarray(link.joint.pos[parent], np.float64))
                fixed[0] = back @ fixed[0]
            previous = last[parent] if parent >= 0 else -1
            for _ in range(1 if kind == "f" else int(kind)):
                dof = len(dof_link)
                count = 6 if kind == "f" else 1
                parts = _joint(angular[dof], linear[dof]) if kind != "f" else np.zeros((4, 2, 4, 4))
                matrices.append(np.einsum("hij,khjl->khil", fixed, parts))
                before.append(previous)
                previous = len(before) - 1
                node_of_dof += [previous] * count
                dof_link += [number] * count
                fixed = np.stack([np.eye(4), np.eye(4)])
            last.append(previous)
        self._before, self._last = before, np.array(last)
        self._matrices = np.asarray(np.stack(matrices, axis=1), np.float32)
        self._node_of_dof, self.dof_links = np.array(node_of_dof), np.array(dof_link)
        self._angular, self._linear = (
            np.asarray(angular, np.float32),
            np.asarray(linear, np.float32),
        )
        self._joints = np.asarray(link.joint.pos, np.float32)
        self._offsets = np.asarray(offsets, np.float32)

    def _levels(self) -> None:
        """Nodes of one depth in the tree, for all of which one product is made."""
        depth: list[int] = []
        for node in self._before:
            depth.append(0 if node < 0 else depth[node] + 1)
        levels = [[i for i, d in enumerate(depth) if d == at] for at in range(max(depth) + 1)]
        order = [node for level in levels for node in level]
        self._order = np.argsort(order)
        self._level_nodes = levels
        self._level_before = [
            [levels[at - 1].index(self._before[node]) for node in level] if at else []
            for at, level in enumerate(levels)
        ]

    def _masks(self) -> None:
        links, dofs = len(self._parents), len(self.dof_links)
        moves = np.zeros((links, dofs), np.float32)
        for number in range(links):
            link = number
            while link >= 0:
                moves[number, self.dof_links == link] = 1
                link = self._parents[link]
        earlier = np.arange(dofs)[None] < np.arange(dofs)[:, None]
        before = moves[self.dof_links] * earlier
        if self._free:
            # Turning about the link's own axes follows its place, and no more.
            before[:6] = 0
            before[3:6, :3] = 1
        self.moved_by, self._after = moves, before
        self.below = moves[self.dof_links] * np.tril(np.ones((dofs, dofs), np.float32))

    def angles(self, q: jax.Array) -> jax.Array:
        """Positions of degrees of freedom, float32 [n, D], at joint positions float32 [n, Q]. Those
        of a free joint's turns are none."""
        return jnp.concatenate([q[:, :6], q[:, 7:]], axis=1) if self._free else q

    def advanced(self, q: jax.Array, qd: jax.Array, step: float) -> jax.Array:
        """Joint positions float32 [n, Q], `step` seconds later at joint velocities [n, D]."""
        if not self._free:
            return q + step * qd
        speed = jnp.sqrt(jnp.square(qd[:, 3:6]).sum(1, keepdims=True)) + 1e-8
        half = 0.5 * step * speed
        turn = jnp.concatenate([jnp.cos(half), jnp.sin(half) / speed * qd[:, 3:6]], axis=1)
        left = einsum("ijk,nk->nij", np.asarray(_LEFT, np.float32), q[:, 3:7])
        turned = (left * turn[:, None]).sum(2)
        turned /= jnp.sqrt(jnp.square(turned).sum(1, keepdims=True))
        moved = q[:, :3] + step * qd[:, :3]
        return jnp.concatenate([moved, turned, q[:, 7:] + step * qd[:, 6:]], axis=1)

    def places(self, q: jax.Array) -> Places:
        """Where links are at joint positions float32 [n, Q]."""
        angles = self.angles(q)
        if self._free:
            # One position for each node; that of a free joint is not used.
            angles = angles[:, 5:]
        halves = jnp.stack([angles, angles / 2], axis=2)[..., None, None]
        constant, sine, cosine, slide = self._matrices
        parts = constant + sine * jnp.sin(halves) + cosine * jnp.cos(halves) + slide * halves
        joined: list[jax.Array] = []
        for nodes, before in zip(self._level_nodes, self._level_before, strict=True):
            level = picked(parts, nodes)
            if joined:
                level = _product(picked(joined[-1], before), level)
            elif self._free:
                level = _free_frame(q)[:, None]
            joined.append(level)
        frames = picked(jnp.concatenate(joined, axis=1), self._order)
        last = picked(frames, self._last)
        quaternions = last[:, :, 1, :, 0]
        rotations = frames[:, :, 0, :3, :3]
        if self._free:
            # Brax scales what hangs on a root whose quaternion is not of length 1, and turns it.
            square = jnp.square(q[:, 3:7]).sum(1)[:, None, None]
            quaternions = quaternions / jnp.sqrt(square)
            turning = rotations / square[..., None]
        else:
            turning = rotations
        of_links = picked(rotations, self._last)
        positions = last[:, :, 0, :3, 3] - rotated(of_links, self._joints)
        of_dofs = picked(turning, self._node_of_dof)
        slides = rotated(of_dofs, self._linear)
        anchors = picked(frames[:, :, 0, :3, 3], self._node_of_dof)
        turning = picked(turning, self._last)
        if self._free:
            slides = jnp.where((np.arange(slides.shape[1]) < 6)[:, None], self._linear, slides)
            hinges = picked(positions, self._parents[1:])
            hinges += rotated(picked(turning, self._parents[1:]), self._offsets[1:])
            anchors = jnp.concatenate([anchors[:, :6], hinges], axis=1)
        return Places(
            positions, quaternions, turning, rotated(of_dofs, self._angular), slides, anchors
        )

    def motions(self, places: Places, qd: jax.Array) -> Motions:
        """Inertia and motion at joint velocities float32 [n, D]."""
        centres = places.positions + rotated(places.rotations, self._centres)
        weights = self.mass / self.mass.sum()
        centre = (centres * weights[:, None]).sum(1)
        offsets = centres - centre[:, None]
        turned = _product(
            _product(places.rotations, self._inertia[None]), places.rotations.swapaxes(2, 3)
        )
        square = jnp.square(offsets).sum(2)[..., None, None] * np.eye(3, dtype=np.float32)
        steiner = square - offsets[..., :, None] * offsets[..., None, :]
        inertia = turned + self.mass[:, None, None] * steiner
        turns = places.axes
        moves = places.slides + cross_products(places.anchors - centre[:, None], turns)
        both = jnp.concatenate([turns, moves], axis=2)
        flows = both * qd[..., None]
        link = einsum("ld,ndk->nlk", self.moved_by, flows)
        earlier = einsum("ed,ndk->nek", self._after, flows)
        turn, move = earlier[..., :3], earlier[..., 3:]
        return Motions(
            centre,
            offsets * self.mass[:, None],
            inertia,
            turns,
            moves,
            link[..., :3],
            link[..., 3:],
            cross_products(turn, turns),
            cross_products(turn, moves) + cross_products(move, turns),
        )


def picked(values: jax.Array, places) -> jax.Array:
    """values[:, places] of values [n, ...], without an index computed as the program runs."""
    places = [int(place) for place in places]
    if places == list(range(values.shape[1])):
        return values
    if places == list(range(places[0], places[0] + len(places))):
        return values[:, places[0] : places[0] + len(places)]
    return jnp.concatenate([values[:, place : place + 1] for place in places], axis=1)


def _product(one: jax.Array, other: jax.Array | np.ndarray) -> jax.Array:
    """Matrix products of [..., i, j] and [..., j, k], as one loop rather than many small calls."""
    return (one[..., :, :, None] * other[..., None, :, :]).sum(-2)


def rotated(rotations: jax.Array, vectors: jax.Array | np.ndarray) -> jax.Array:
    """Rotations [..., 3, 3] times vectors [..., 3]."""
    return (rotations * vectors[..., None, :]).sum(-1)


def cross_products(one: jax.Array, other: jax.Array) -> jax.Array:
    """Cross products of [..., 3]."""

    def rolled(x):
        return jnp.concatenate([x[..., 1:], x[..., :1]], axis=-1)

    return rolled(one * rolled(other) - rolled(one) * other)


def _free_frame(q: jax.Array) -> jax.Array:
    """Both matrices of a free joint, float32 [n, 2, 4, 4]; its quaternion need not be of length 1,
    and then scales."""
    left = einsum("ijk,nk->nij", np.asarray(_LEFT, np.float32), q[:, 3:7])
    right = einsum("ijk,nk->nij", np.asarray(_RIGHT_INVERSE, np.float32), q[:, 3:7])
    turn = _product(left, right)[:, 1:, 1:]
    top = jnp.concatenate([turn, q[:, :3, None]], axis=2)
    bottom = jnp.broadcast_to(np.asarray([0, 0, 0, 1], np.float32), (len(q), 1, 4))
    return jnp.stack([jnp.concatenate([top, bottom], axis=1), left], axis=1)


# Of quaternions (w, x, y, z) p and q: p q = (_LEFT p) q, and q times p with its last three numbers
# negated is (_RIGHT_INVERSE p) q.
_LEFT = np.zeros((4, 4, 4))
for _i, _signed in enumerate([[1, -2, -3, -4], [2, 1, -4, 3], [3, 4, 1, -2], [4, -3, 2, 1]]):
    for _j, _k in enumerate(_signed):
        _LEFT[_i, _j, abs(_k) - 1] = np.sign(_k)
_RIGHT_INVERSE = _LEFT.transpose(2, 0, 1)


def _left(quaternion) -> np.ndarray:
    """The matrix [4, 4] that multiplies by a quaternion from the left."""
    return _LEFT @ np.asarray(quaternion, np.float64)


def rotation_of(quaternion) -> np.ndarray:
    """The rotation [3, 3] of a quaternion of length 1."""
    quaternion = np.asarray(quaternion, np.float64)
    return (_left(quaternion) @ (_RIGHT_INVERSE @ quaternion))[1:, 1:]


def _frame(position, quaternion=(1, 0, 0, 0)) -> np.ndarray:
    """A frame as a matrix [4, 4]."""
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation_of(quaternion), position
    return frame


def _joint(angular: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Both matrices of an axis, as factors [4, 2, 4, 4] of 1, sin, cos and the position itself; the
    second takes half the position."""
    parts = np.zeros((4, 2, 4, 4))
    skew = np.cross(np.eye(3), np.asarray(angular, np.float64))
    along = np.eye(3) * float(not angular.any()) + np.outer(angular, angular)
    parts[0, 0, :3, :3], parts[0, 0, 3, 3] = along, 1
    parts[1, 0, :3, :3] = skew
    parts[2, 0, :3, :3] = np.eye(3) - along
    parts[3, 0, :3, 3] = linear
    if angular.any():
        parts[1, 1] = _left([0, *angular])
        parts[2, 1] = np.eye(4)
    else:
        parts[0, 1] = np.eye(4)
    return parts
