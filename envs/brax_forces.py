"""What moves the links of a tree: one step of Brax's generalized engine for many states at once.

Brax computes the same joint by joint and contact by contact, in thousands of operations on a few
numbers each. Here inertias are 6 x 6 matrices, what depends on the tree is a product with a matrix
of zeros and ones, contacts and limits of joints are rows of one matrix, and the solver tries many
lengths of a step at once.

n states, L links, D degrees of freedom, Q joint positions, R constraints (four for each point of
contact, one for each limited joint). Vectors of 6 are angular parts before linear ones.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.brax_chain import (
    Chain,
    Motions,
    Places,
    cross_products,
    einsum,
    picked,
    rotated,
    rotation_of,
)

# MuJoCo's numbers of these kinds of geometries.
_PLANE, _SPHERE, _CAPSULE = 0, 2, 3

# The floor's normal, and one side of a point's frame where no capsule lies.
_UP, _ACROSS = np.eye(3, dtype=np.float32)[[2, 1]]

# The matrix of v -> h x v as a linear function of h.
_SKEW = np.asarray([np.cross(np.eye(3), row) for row in np.eye(3)], np.float32)


class _Point(NamedTuple):
    """One point at which a link can touch the floor.

    Attributes:
      link: number of the link.
      place: of the ball around the point, [3] in the link's frame.
      radius: of that ball.
      axis: of the capsule whose end it is, [3] in the link's frame; zero for a sphere.
      friction: of the floor and the link, the greater.
    """

    link: int
    place: np.ndarray
    radius: float
    axis: np.ndarray
    friction: float


class Forces:
    """Forces and constraints of a system.

    Args:
      system: a `brax.System`.
      chain: of the same system.

    Raises:
      ValueError: something is in the system that is not known here.
    """

    def __init__(self, system, chain: Chain):
        self._chain, self._step = chain, float(system.opt.timestep)
        dof, actuator = system.dof, system.actuator
        self._gravity = np.concatenate([np.zeros(3), -np.asarray(system.gravity)]).astype("f4")
        self._damping, self._stiffness = np.asarray(dof.damping), np.asarray(dof.stiffness)
        self._armature = np.diag(np.asarray(dof.armature))
        self._control = np.asarray(actuator.ctrl_range)
        self._pushes = np.zeros((len(self._control), len(self._damping)), np.float32)
        self._pushes[np.arange(len(self._control)), np.asarray(actuator.qd_id)] = actuator.gear
        if (
            np.any(actuator.bias_q)
            or np.any(actuator.bias_qd)
            or np.any(actuator.gain != 1)
            or np.isfinite(actuator.force_range).any()
            or system.matrix_inv_iterations == 0
        ):
            raise ValueError(
                "the system has actuators that are no motors, or no iterations for the inverse of "
                "its mass matrix: expected motors, and such iterations"
            )
        self._iterations, self._trials = int(system.solver_iterations), int(system.solver_maxls)
        self._points(system)
        self._limits(system)

    def _points(self, system) -> None:
        """Where links can touch the floor, which is the one thing that they can touch."""
        from mujoco import mjx

        points, floor, kinds = [], -1, np.asarray(system.geom_type)
        bodies, sizes = np.asarray(system.geom_bodyid), np.asarray(system.geom_size)
        touches = np.asarray(system.geom_contype)[:, None] & np.asarray(system.geom_conaffinity)
        touches = (touches | touches.T) != 0
        for one, other in zip(*np.nonzero(np.triu(touches, 1)), strict=True):
            if bodies[one] == bodies[other]:
                continue
            if kinds[one] != _PLANE or bodies[one] or kinds[other] not in (_SPHERE, _CAPSULE):
                # MuJoCo leaves out what is joined, and the engine has collisions of its own kinds.
                continue
            if abs(rotation_of(system.geom_quat[one])[2, 2] - 1) > 1e-6:
                continue
            floor = one
            turned = rotation_of(system.geom_quat[other])
            place, radius = np.asarray(system.geom_pos[other], np.float64), float(sizes[other, 0])
            axis = turned[:, 2] * (kinds[other] == _CAPSULE)
            friction = float(max(system.geom_friction[one, 0], system.geom_friction[other, 0]))
            for side in (1, -1) if axis.any() else (0,):
                end = place + side * axis * sizes[other, 1]
                points.append(_Point(int(bodies[other]) - 1, end, radius, axis, friction))
        known = len(points)
        expected = int(mjx.make_data(system)._impl.ncon)
        one_kind = all(
            len(np.unique(np.asarray(x), axis=0)) == 1
            for x in (system.geom_solref, system.geom_solimp, system.geom_priority)
        )
        if known != expected or (known and not one_kind) or system.npair:
            raise ValueError(
                f"the system has {expected} points of contact, of which {known} are of spheres or "
                "capsules with a level floor: expected no others, and one set of the solver's "
                "numbers"
            )
        self._links = [point.link for point in points]
        if not points:
            return
        self._places = np.asarray([point.place for point in points], np.float32)
        self._radii = np.asarray([point.radius for point in points], np.float32)
        self._axes = np.asarray([point.axis for point in points], np.float32)
        self._friction = np.asarray([point.friction for point in points], np.float32)
        self._height = np.float32(system.geom_pos[floor, 2])
        self._contact = np.concatenate([system.geom_solref[floor], system.geom_solimp[floor]])
        weights = np.asarray(system.link.invweight)[self._links] * (1 + self._friction**2)
        self._contact_weights = 2 * self._friction**2 * weights

    def _limits(self, system) -> None:
        """Degrees of freedom whose positions are limited."""
        limits = np.asarray(system.dof.limit)
        limited = np.flatnonzero(np.isfinite(limits).any(0))
        self._limited, self._bounds = limited.tolist(), limits[:, limited]
        self._limit_rows = np.eye(limits.shape[1], dtype=np.float32)[limited]
        self._limit = np.asarray(system.dof.solver_params)[limited]
        self._limit_weights = np.asarray(system.dof.invweight)[limited]

    def moved(
        self, q: jax.Array, qd: jax.Array, places: Places, motions: Motions, controls: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """One step.

        Args:
          q: joint positions, float32 [n, Q].
          qd: joint velocities, float32 [n, D].
          places: at these positions.
          motions: at these velocities.
          controls: of the actuators, float32 [n, |A|].

        Returns:
          Joint positions and velocities after it.
        """
        matrix, forces = self._smooth(q, qd, motions, controls)
        rows, diagonal, aims = self._constraints(q, qd, places, motions)
        # With M = K K', what is needed of M's inverse comes of K's.
        root = jax.lax.linalg.cholesky(matrix, symmetrize_input=False)
        both = jnp.concatenate([rows, forces[:, None]], axis=1).swapaxes(1, 2)
        both = jax.lax.linalg.triangular_solve(root, both, left_side=True, lower=True)
        both = both.swapaxes(1, 2)
        rows, forces = both[:, :-1], both[:, -1]
        square = einsum("nrd,nsd->nrs", rows, rows)
        square += diagonal[..., None] * np.eye(diagonal.shape[1], dtype=np.float32)
        offset = (rows * forces[:, None]).sum(-1) - aims
        pushes = solved(square, offset, self._iterations, self._trials)
        forces += (pushes[..., None] * rows).sum(1)
        accelerations = jax.lax.linalg.triangular_solve(
            root, forces[..., None], left_side=True, lower=True, transpose_a=True
        )
        qd = qd + self._step * accelerations[..., 0]
        return self._chain.advanced(q, qd, self._step), qd

    def _smooth(self, q, qd, motions: Motions, controls):
        """The mass matrix float32 [n, D, D], and the forces that are no constraints [n, D]."""
        chain = self._chain
        inertias = self._inertias(motions)
        axes = jnp.concatenate([motions.turns, motions.moves], axis=2)
        rates = jnp.concatenate([motions.turns_rate, motions.moves_rate], axis=2)
        speeds = jnp.concatenate([motions.link_turns, motions.link_moves], axis=2)
        # What hangs on each degree of freedom, as one body.
        carried = einsum("ld,nlij->ndij", chain.moved_by, inertias)
        weights = (carried * axes[:, :, None, :]).sum(-1)
        matrix = einsum("nik,njk->nij", weights, axes) * chain.below
        matrix += np.tril(np.ones_like(chain.below), -1).T * matrix.swapaxes(1, 2)
        matrix += self._armature

        accelerations = einsum("ld,ndk->nlk", chain.moved_by, rates * qd[..., None]) + self._gravity
        momenta = (inertias * speeds[:, :, None, :]).sum(-1)
        forces = (inertias * accelerations[:, :, None, :]).sum(-1)
        turn, move = speeds[..., :3], speeds[..., 3:]
        forces += jnp.concatenate(
            [
                cross_products(turn, momenta[..., :3]) + cross_products(move, momenta[..., 3:]),
                cross_products(turn, momenta[..., 3:]),
            ],
            axis=2,
        )
        bias = (einsum("ld,nlk->ndk", chain.moved_by, forces) * axes).sum(-1)
        controls = jnp.clip(controls, self._control[:, 0], self._control[:, 1])
        pushes = einsum("na,ad->nd", controls, self._pushes)
        springs = self._stiffness * chain.angles(q) + self._damping * qd
        return matrix, pushes - springs - bias

    def _inertias(self, motions: Motions) -> jax.Array:
        """Of links about the centre of mass, float32 [n, L, 6, 6]."""
        skew = einsum("nlh,hij->nlij", motions.moments, _SKEW)
        mass = jnp.broadcast_to(self._chain.mass[:, None, None] * np.eye(3, dtype="f4"), skew.shape)
        top = jnp.concatenate([motions.inertia, skew], axis=3)
        return jnp.concatenate([top, jnp.concatenate([-skew, mass], axis=3)], axis=2)

    def _constraints(self, q, qd, places: Places, motions: Motions):
        """Rows float32 [n, R, D], what is added to the solver's diagonal [n, R], and the
        accelerations along the rows that are aimed at [n, R]. All are 0 where nothing holds."""
        found = []
        if self._links:
            found.append(self._contacts(qd, places, motions))
        if self._limited:
            angles = picked(self._chain.angles(q), self._limited)
            below, above = angles - self._bounds[0], self._bounds[1] - angles
            depth = jnp.minimum(jnp.minimum(below, above), 0)
            side = jnp.where(below < above, 1.0, -1.0) * (depth < 0)
            speeds = side * picked(qd, self._limited)
            give, aims = _impedance(self._limit.T, depth, speeds)
            diagonal = self._limit_weights * give
            found.append(
                (
                    side[..., None] * self._limit_rows,
                    jnp.where(depth < 0, diagonal, 0.0),
                    jnp.where(depth < 0, aims, 0.0),
                )
            )
        return (jnp.concatenate(parts, axis=1) for parts in zip(*found, strict=True))

    def _contacts(self, qd, places: Places, motions: Motions):
        """The constraints of points of contact: four each, along the edges of a pyramid."""
        count, points = len(qd), len(self._links)
        rotations = picked(places.rotations, self._links)
        balls = picked(places.positions, self._links) + rotated(rotations, self._places)
        depth = balls[..., 2] - self._height - self._radii
        at = balls - _UP * (self._radii + 0.5 * depth)[..., None]
        # Velocities of the points for one unit of each degree of freedom.
        arms = (at - motions.centre[:, None])[:, :, None]
        speeds = motions.moves[:, None] + cross_products(motions.turns[:, None], arms)
        speeds *= self._chain.moved_by[self._links][..., None]
        # Along the capsule as far as it lies on the floor.
        along = rotated(rotations, self._axes) * (1 - _UP)
        length = jnp.sqrt(jnp.square(along).sum(-1, keepdims=True))
        along = jnp.where(length < 0.5, _ACROSS, along / jnp.maximum(length, 1e-6))
        across = cross_products(jnp.broadcast_to(_UP, along.shape), along)
        sides = jnp.stack([along, across], axis=2) * self._friction[:, None, None]
        edges = jnp.concatenate([sides, -sides], axis=2) + _UP
        rows = (edges[:, :, :, None] * speeds[:, :, None]).sum(-1)
        touching = (depth < 0)[..., None]
        give, aims = _impedance(self._contact, depth[..., None], (rows * qd[:, None, None]).sum(-1))
        diagonal = jnp.broadcast_to(self._contact_weights[:, None] * give, aims.shape)
        rows = jnp.where(touching[..., None], rows, 0.0)
        return (
            rows.reshape(count, 4 * points, -1),
            jnp.where(touching, diagonal, 0.0).reshape(count, -1),
            jnp.where(touching, aims, 0.0).reshape(count, -1),
        )


def _impedance(numbers, depth: jax.Array, speeds: jax.Array) -> tuple[jax.Array, jax.Array]:
    """How far constraints give way, and the accelerations that they aim at.

    MuJoCo's (https://mujoco.readthedocs.io/en/latest/modeling.html#solver-parameters), as in Brax.

    Args:
      numbers: the seven of the solver: time constant, damping ratio, and five of the impedance.
      depth: below 0 where a constraint is violated, in metres or radians.
      speeds: along the constraints.
    """
    time, ratio, least, most, width, middle, power = (np.asarray(x, np.float64) for x in numbers)
    damping = np.where(ratio <= 0, -ratio / most, 2 / (most * time))
    with np.errstate(divide="ignore"):
        stiffness = np.where(
            time <= 0, -time / most**2, 1 / (most * time * np.maximum(ratio, 0)) ** 2
        )
    x = jnp.abs(depth) / np.float32(width)
    low = np.float32(1 / middle ** (power - 1)) * _power(x, power)
    high = 1 - np.float32(1 / (1 - middle) ** (power - 1)) * _power(1 - x, power)
    share = jnp.where(x > 1, 1.0, jnp.where(x < np.float32(middle), low, high))
    held = jnp.clip(np.float32(least) + share * np.float32(most - least), least, most)
    held = jnp.where(x > 1, np.float32(most), held)
    aims = -np.float32(damping) * speeds - np.float32(stiffness) * held * depth
    return (1 - held) / (held + 1e-8), aims


def _power(x: jax.Array, power: np.ndarray) -> jax.Array:
    """x to a constant power, by multiplication if that is 2 throughout."""
    return x * x if np.all(power == 2) else jnp.power(jnp.maximum(x, 0), np.float32(power))


_AT_ONCE = 8
"""Lengths of a step that the solver tries at once."""


def solved(matrix: jax.Array, offset: jax.Array, iterations: int, trials: int) -> jax.Array:
    """The x of no negative numbers for which (A x + b)^2 is least, or one on the way there.

    As Brax finds it: projected gradients with acceleration and a search for the length of each
    step (Beck and Teboulle, 2009; `jaxopt.ProjectedGradient`), begun at 0.

    Args:
      matrix: A, symmetric, float32 [n, R, R].
      offset: b, float32 [n, R].
      iterations: how many steps are made at most.
      trials: how often the length of a step is halved at most.
    """
    epsilon = jnp.finfo(matrix.dtype).eps
    halved = np.float32(0.5) ** np.arange(_AT_ONCE, dtype=np.float32)

    def step(carry):
        count, x, y, momentum, length, going = carry
        residual = einsum("nrs,ns->nr", matrix, y) + offset
        value = 0.5 * jnp.square(residual).sum(-1)
        slope = einsum("nrs,nr->ns", matrix, residual)

        def search(carry):
            tried, first, point, chosen, found = carry
            lengths = first[:, None] * halved
            points = jnp.maximum(y[:, None] - lengths[..., None] * slope[:, None], 0)
            ways = points - y[:, None]
            residuals = einsum("nrs,nks->nkr", matrix, points) + offset[:, None]
            gains = lengths * (0.5 * jnp.square(residuals).sum(-1) - value[:, None])
            bounds = lengths * (ways * slope[:, None]).sum(-1) + 0.5 * jnp.square(ways).sum(-1)
            enough = ~(gains > bounds + epsilon) | (np.arange(_AT_ONCE) + tried >= trials)
            which = jnp.argmax(enough, axis=1)[:, None] == np.arange(_AT_ONCE)
            new = jnp.where(which[..., None], points, 0.0).sum(1)
            point = jnp.where(found[:, None], point, new)
            chosen = jnp.where(found, chosen, jnp.where(which, lengths, 0.0).sum(1))
            return tried + _AT_ONCE, first * halved[-1] / 2, point, chosen, found | enough.any(1)

        start = (0, length, y, length, ~going)
        _, _, point, chosen, _ = jax.lax.while_loop(lambda carry: ~carry[-1].all(), search, start)
        chosen = jnp.where(chosen <= 1e-6, 1.0, 2 * chosen)
        faster = 0.5 * (1 + jnp.sqrt(1 + 4 * momentum**2))
        way = point - x
        ahead = point + ((momentum - 1) / faster)[:, None] * way
        error = jnp.sqrt(jnp.square(way).sum(-1)) / chosen
        return (
            count + 1,
            jnp.where(going[:, None], point, x),
            jnp.where(going[:, None], ahead, y),
            jnp.where(going, faster, momentum),
            jnp.where(going, chosen, length),
            going & (error > 1e-3),
        )

    nothing, one = jnp.zeros_like(offset), jnp.ones_like(offset[:, 0])
    start = (0, nothing, nothing, one, one, one != 0)
    return jax.lax.while_loop(lambda carry: (carry[0] < iterations) & carry[-1].any(), step, start)[
        1
    ]
