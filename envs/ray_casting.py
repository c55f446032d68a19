"""Pictures of rigid bodies by analytic ray casting: a pure function, part of any jitted program.

    scene = envs.scene.scene_of(system)            # a brax.System or a mujoco.MjModel
    image = render(scene, state.x.pos, state.x.rot, size=64)

`render` needs no driver, no host and no state. It maps under `jax.vmap` over anything, and draws
planes, spheres, capsules, ellipsoids, cylinders and boxes at any size. Light falls as in MuJoCo's
own pictures (OpenGL's fixed functions, no shadows), so that both look alike.

G geometries, L links, N pixels. Arrays of pixels are flat and their axis is the last one;
geometries are unrolled, so that a picture is one loop over pixels. Rays have the length 1 along the
camera's axis, so that a distance along a ray is a depth.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import LEAST_SIZE, check_whole
from envs.scene import Camera, Checker, Scene

_FAR_AWAY = jnp.inf


def check_size(size: Any, supersample: Any = 1) -> None:
    """Raise a ValueError unless pictures can have this size in pixels."""
    check_whole("an image size of ", size, LEAST_SIZE)
    check_whole("supersample=", supersample, 1)


def render(
    scene: Scene,
    positions: jax.Array,
    rotations: jax.Array,
    size: int = 64,
    supersample: int = 1,
) -> jax.Array:
    """The picture of a scene. Jitted; map it with `jax.vmap` for many pictures.

    Args:
      scene: what is seen.
      positions: of the links in the world, float [L, 3], in metres.
      rotations: of the links in the world, quaternions (w, x, y, z), float [L, 4]; their
        length is of no weight.
      size: height and width in pixels, at least 8.
      supersample: draw this many times as high and wide, and let each pixel be the mean of
        those that it covers.

    Returns:
      uint8 [size, size, 3].

    Raises:
      ValueError: for a size or shape that does not fit.
    """
    check_size(size, supersample)
    positions, rotations = jnp.asarray(positions), jnp.asarray(rotations)
    links = len(positions) if positions.ndim == 2 else 0
    if positions.shape != (links, 3) or rotations.shape != (links, 4) or links < scene.links:
        raise ValueError(
            f"got positions of shape {positions.shape} and rotations of shape {rotations.shape}, "
            f"expected [L, 3] and [L, 4] of at least {scene.links} links: map over several "
            "pictures with jax.vmap"
        )
    return _render(scene, positions, rotations, int(size), int(supersample))


@functools.partial(jax.jit, static_argnums=(0, 3, 4))
def _render(scene, positions, rotations, size, supersample):
    wide = size * supersample
    colours = _cast(scene, _frames(scene, positions, rotations), wide)
    # As one word a pixel, so that the loop over pixels ends in one array.
    red, green, blue = (jnp.round(255 * jnp.clip(x, 0, 1)).astype(jnp.uint32) for x in colours)
    words = jax.lax.optimization_barrier(red | green << 8 | blue << 16)
    image = words[:, None] >> jnp.array([0, 8, 16], jnp.uint32) & 255
    if supersample > 1:
        blocks = image.reshape(size, supersample, size, supersample, 3)
        area = supersample**2
        image = (blocks.sum((1, 3)) + area // 2) // area
    return image.astype(jnp.uint8).reshape(size, size, 3)


# Frames


def _matrices(quaternions):
    """Rotation matrices of quaternions of any length but 0: [..., 4] -> [..., 3, 3]."""
    w, x, y, z = jnp.moveaxis(quaternions, -1, 0)
    s = 2.0 / (w * w + x * x + y * y + z * z)
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def _eye(camera: Camera, positions):
    """Where the camera is, float32 [3]."""
    target = jnp.array(camera.target, jnp.float32)
    if any(camera.follows):
        target = jnp.where(np.array(camera.follows), positions[camera.link], target)
    return target - jnp.float32(camera.distance * camera.axes()[:, 2])


def _frames(scene: Scene, positions, rotations):
    """How each geometry sees the camera, and where the camera is.

    Returns:
      float32 [G, 3, 4]: the camera's axes right, up and forwards, and its place, as columns in
      the geometry's frame; and float32 [3].
    """
    highest = jax.lax.Precision.HIGHEST
    links = np.array([geometry.link for geometry in scene.geometries])
    own = _matrices(jnp.array([geometry.rotation for geometry in scene.geometries], jnp.float32))
    places = jnp.array([geometry.position for geometry in scene.geometries], jnp.float32)
    # The world is a link that stays where it is.
    positions = jnp.concatenate([positions.astype(jnp.float32), jnp.zeros((1, 3))])
    turned = jnp.concatenate([_matrices(rotations.astype(jnp.float32)), jnp.eye(3)[None]])
    turned = turned[links]
    centres = positions[links] + jnp.einsum("gij,gj->gi", turned, places, precision=highest)
    turned = jnp.einsum("gij,gjk->gik", turned, own, precision=highest)
    eye = _eye(scene.camera, positions)
    axes = jnp.broadcast_to(jnp.float32(scene.camera.axes()), (len(links), 3, 3))
    columns = jnp.concatenate([axes, (eye - centres)[..., None]], -1)
    frames = jnp.einsum("gji,gjk->gik", turned, columns, precision=highest)
    # Kept out of the loop over pixels, which would do all this again for each.
    return jax.lax.optimization_barrier((frames, eye))


# Hits: of a ray from `origin` along `ray` (three arrays or numbers each) in a geometry's frame.
# Each gives the depth, infinite where the ray misses, and the normal.


def _root(half_b, a, c):
    """The smaller root of a t^2 + 2 half_b t + c, infinite where there is none."""
    square = half_b * half_b - a * c
    return jnp.where(square > 0, (-half_b - jnp.sqrt(jnp.maximum(square, 0))) / a, _FAR_AWAY)


def _point(origin, ray, depth):
    return [o + depth * d for o, d in zip(origin, ray, strict=True)]


def _dot(one, other):
    return sum(a * b for a, b in zip(one, other, strict=True))


def _hit_plane(size, origin, ray):
    depth = jnp.where((ray[2] < 0) & (origin[2] > 0), -origin[2] / ray[2], _FAR_AWAY)
    for axis in (0, 1):
        if size[axis] > 0:
            along = origin[axis] + depth * ray[axis]
            depth = jnp.where(jnp.abs(along) <= size[axis], depth, _FAR_AWAY)
    return depth, (0.0, 0.0, 1.0)


def _hit_sphere(size, origin, ray):
    depth = _root(_dot(origin, ray), _dot(ray, ray), _dot(origin, origin) - size[0] ** 2)
    return depth, [x / size[0] for x in _point(origin, ray, depth)]


def _hit_capsule(size, origin, ray):
    """A ray that meets the endless tube where the capsule is meets it there; one that meets the
    tube beyond an end can only meet the ball at that end."""
    radius, half = size[:2]
    b = origin[0] * ray[0] + origin[1] * ray[1]
    a = jnp.maximum(ray[0] * ray[0] + ray[1] * ray[1], 1e-12)
    c = origin[0] * origin[0] + origin[1] * origin[1] - radius**2
    tube = _root(b, a, c)
    height = origin[2] + jnp.where(jnp.isfinite(tube), tube, 0.0) * ray[2]
    middle = jnp.clip(height, -half, half)
    down = origin[2] - middle
    ball = _root(b + down * ray[2], a + ray[2] * ray[2], c + down * down)
    depth = jnp.where(jnp.isfinite(tube) & (middle != height), ball, tube)
    x, y, z = _point(origin, ray, depth)
    return depth, [x / radius, y / radius, (z - middle) / radius]


def _hit_cylinder(size, origin, ray):
    radius, half = size[:2]
    b = origin[0] * ray[0] + origin[1] * ray[1]
    a = jnp.maximum(ray[0] * ray[0] + ray[1] * ray[1], 1e-12)
    c = origin[0] * origin[0] + origin[1] * origin[1] - radius**2
    side = _root(b, a, c)
    side = jnp.where(jnp.abs(origin[2] + side * ray[2]) <= half, side, _FAR_AWAY)
    # The end that faces the camera.
    end = jnp.where(origin[2] > 0, half, -half)
    lid = (end - origin[2]) / ray[2]
    x, y, _ = _point(origin, ray, lid)
    outside = (jnp.abs(origin[2]) > half) & (x * x + y * y <= radius**2)
    lid = jnp.where(outside, lid, _FAR_AWAY)
    depth = jnp.minimum(side, lid)
    on_side = side < lid
    x, y, _ = _point(origin, ray, depth)
    lid_normal = jnp.where(origin[2] > 0, 1.0, -1.0)
    normal = [jnp.where(on_side, x / radius, 0.0), jnp.where(on_side, y / radius, 0.0)]
    return depth, [*normal, jnp.where(on_side, 0.0, lid_normal)]


def _hit_box(size, origin, ray):
    enter: Any = -_FAR_AWAY
    leave: Any = _FAR_AWAY
    faces = []
    for o, d, half in zip(origin, ray, size, strict=True):
        d = jnp.where(jnp.abs(d) < 1e-12, 1e-12, d)
        middle, reach = -o / d, jnp.abs(half / d)
        enter = jnp.maximum(enter, middle - reach)
        leave = jnp.minimum(leave, middle + reach)
        faces.append(middle - reach)
    depth = jnp.where(enter < leave, enter, _FAR_AWAY)
    front = [face == enter for face in faces]
    return depth, [jnp.where(x, -jnp.sign(d), 0.0) for x, d in zip(front, ray, strict=True)]


def _hit_ellipsoid(size, origin, ray):
    origin = [x / r for x, r in zip(origin, size, strict=True)]
    ray = [x / r for x, r in zip(ray, size, strict=True)]
    depth = _root(_dot(origin, ray), _dot(ray, ray), _dot(origin, origin) - 1.0)
    normal = [x / r for x, r in zip(_point(origin, ray, depth), size, strict=True)]
    length = jax.lax.rsqrt(jnp.maximum(_dot(normal, normal), 1e-12))
    return depth, [x * length for x in normal]


_HITS = {
    "plane": _hit_plane,
    "sphere": _hit_sphere,
    "capsule": _hit_capsule,
    "ellipsoid": _hit_ellipsoid,
    "cylinder": _hit_cylinder,
    "box": _hit_box,
}


# Colours


def _cast(scene: Scene, frames, wide: int):
    """The colours that N = wide * wide rays bring home: red, green and blue, each float32 [N]."""
    frames, eye = frames
    camera = scene.camera
    across = (2 * (np.arange(wide) + 0.5) / wide - 1) * math.tan(
        math.radians(camera.field_of_view) / 2
    )
    step = 2 * math.tan(math.radians(camera.field_of_view) / 2) / wide
    right, up = (jnp.asarray(x.reshape(-1), jnp.float32) for x in np.meshgrid(across, -across))
    depth = jnp.full(wide * wide, _FAR_AWAY)
    normal: list[Any] = [0.0] * 3
    colour: list[Any] = [0.0] * 3
    pattern: list[Any] = [1.0] * 3
    gloss: Any = 0.0
    shininess: Any = 1.0
    checkered = any(geometry.checker for geometry in scene.geometries)
    for geometry, frame in zip(scene.geometries, frames, strict=True):
        ray = [row[0] * right + row[1] * up + row[2] for row in frame]
        origin = [row[3] for row in frame]
        hit, turned = _HITS[geometry.kind](geometry.size, origin, ray)
        nearest = (hit < depth) & (hit > camera.near)
        own = (1.0, 1.0, 1.0)
        if geometry.checker is not None:
            own = _checkered(geometry.checker, frame, origin, ray, hit, step)
        # The rows of a frame are the geometry's axes as the camera sees them.
        seen = [_dot(turned, [row[axis] for row in frame]) for axis in range(3)]
        depth = jnp.where(nearest, hit, depth)
        normal = _nearer(nearest, seen, normal)
        colour = _nearer(nearest, geometry.colour, colour)
        if checkered:
            pattern = _nearer(nearest, own, pattern)
        gloss = jnp.where(nearest, geometry.specular, gloss)
        shininess = jnp.where(nearest, geometry.shininess, shininess)
    length = jnp.sqrt(right * right + up * up + 1)
    lit = _lit(scene, eye, [depth * right, depth * up, depth], normal, colour, gloss, shininess)
    lit = [jnp.minimum(x, 1.0) * y for x, y in zip(lit, pattern, strict=True)]
    return _nearer(depth * length < camera.far, lit, scene.sky)


def _nearer(nearest, new, old):
    return [jnp.where(nearest, x, y) for x, y in zip(new, old, strict=True)]


def _checkered(checker: Checker, frame, origin, ray, depth, step):
    """The colours of a plane where rays meet it, each the mean over about what a pixel covers."""
    fields, spans = [], []
    for axis in (0, 1):
        place = origin[axis] + depth * ray[axis] - checker.corner[axis]
        fields.append(place / checker.width[axis])
        # How fast the place changes from pixel to pixel, to the right and up.
        slope = [
            depth * step * (frame[axis][way] - ray[axis] * frame[2][way] / ray[2]) for way in (0, 1)
        ]
        spans.append([x / checker.width[axis] for x in slope])
    (a, b), (c, d) = spans
    width = jnp.sqrt(jnp.maximum(a * a + c * c, b * b + d * d))
    # The mean of a square wave (1, -1, 1, ...) over `width` around a place.
    width = jnp.maximum(width, 1e-4)
    waves = [(_wave(x + width / 2) - _wave(x - width / 2)) / width for x in fields]
    share = jnp.where(jnp.isfinite(depth), 0.5 + 0.5 * waves[0] * waves[1], 0.5)
    return [share * own + (1 - share) * other for own, other in zip(*checker.colours, strict=True)]


def _wave(x):
    """The integral of a square wave that is 1 on [0, 1), -1 on [1, 2), and so on."""
    half = x / 2
    return 1 - jnp.abs(2 * (half - jnp.floor(half)) - 1)


def _lit(scene: Scene, eye, point, normal, colour, gloss, shininess):
    """The colours of surfaces in the light, as OpenGL's fixed functions give them."""
    axes = scene.camera.axes()
    exponents = sorted({geometry.shininess for geometry in scene.geometries})
    diffuse: list[Any] = [0.0] * 3
    shine: list[Any] = [0.0] * 3
    for light in scene.lights:
        weight: Any = 1.0
        towards: list[Any]
        if light.kind == "head":
            towards = [0.0, 0.0, -1.0]
        elif light.kind == "directional":
            direction = axes.T @ np.array(light.direction)
            towards = [float(x) for x in -direction / np.linalg.norm(direction)]
        else:
            place = jnp.float32(axes.T) @ (jnp.array(light.position, jnp.float32) - eye)
            away = [place[axis] - point[axis] for axis in range(3)]
            length = jax.lax.rsqrt(_dot(away, away))
            towards = [x * length for x in away]
            if light.cutoff < 90:
                direction = axes.T @ np.array(light.direction)
                axis = [float(x) for x in -direction / np.linalg.norm(direction)]
                cosine = jnp.maximum(_dot(towards, axis), 1e-6)
                weight = jnp.where(
                    cosine > math.cos(math.radians(light.cutoff)),
                    _power(cosine, light.exponent),
                    0.0,
                )
        falls = _dot(normal, towards)
        between = [towards[0], towards[1], towards[2] - 1.0]
        length = _dot(between, between)
        inverse = 1 / math.sqrt(length) if isinstance(length, float) else jax.lax.rsqrt(length)
        facing = jnp.maximum(_dot(normal, between) * inverse, 0.0)
        powers = _power(facing, exponents[0])
        for exponent in exponents[1:]:
            powers = jnp.where(shininess == exponent, _power(facing, exponent), powers)
        highlight = jnp.where(falls > 0, weight * gloss * powers, 0.0)
        falls = weight * jnp.maximum(falls, 0.0)
        diffuse = [
            total + ambient * weight + part * falls
            for total, ambient, part in zip(diffuse, light.ambient, light.diffuse, strict=True)
        ]
        shine = [
            total + part * highlight for total, part in zip(shine, light.specular, strict=True)
        ]
    return [c * d + s for c, d, s in zip(colour, diffuse, shine, strict=True)]


def _power(x, exponent: float):
    if float(exponent).is_integer() and exponent <= 256:
        return jax.lax.integer_pow(x, int(exponent))
    return jnp.exp2(exponent * jnp.log2(jnp.maximum(x, 1e-6)))
