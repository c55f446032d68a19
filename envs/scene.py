"""What a picture shows but for where the bodies are: geometries, lights, a camera.

A scene is a constant of the program that draws it (`envs.ray_casting`): plain numbers, hashable.
`scene_of` reads one from a model of Brax or MuJoCo; others can be written down. Imports no JAX.

Links are the bodies of a model but for the world, in the model's order, as in Brax.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box")
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Checker:
    """A pattern of two colours, by which a plane's own is multiplied.

    Attributes:
      colours: of the fields, the first of that which begins at `corner` towards +x and +y.
      width: of a field along x and y, in metres.
      corner: where four fields meet, x and y in the plane's frame, in metres.
    """

    colours: tuple[Vector, Vector]
    width: tuple[float, float]
    corner: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Geometry:
    """One body that rays can hit.

    Attributes:
      kind: "plane", "sphere", "capsule", "ellipsoid", "cylinder" or "box".
      size: as in MuJoCo, in metres: radius (sphere); radius and half length along z (capsule,
        whose ends come on top, and cylinder); three radii (ellipsoid); three half lengths
        (box); half lengths along x and y, or 0 for no end (plane, seen from +z).
      colour: red, green and blue, each in [0, 1].
      link: the link it is fixed to; -1 for the world.
      position: in the link's frame, in metres.
      rotation: in the link's frame, a quaternion (w, x, y, z).
      specular: share of a light's specular part that is reflected.
      shininess: the exponent of highlights.
      checker: of a plane, its pattern.
    """

    kind: str
    size: Vector
    colour: Vector
    link: int = -1
    position: Vector = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    specular: float = 0.5
    shininess: float = 64.0
    checker: Checker | None = None

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(f"cannot draw a {self.kind!r}, expected one of {', '.join(KINDS)}")
        if self.checker is not None and self.kind != "plane":
            raise ValueError(f"only planes have checkers, not a {self.kind}")


@dataclass(frozen=True)
class Light:
    """A light of one of three kinds.

    Attributes:
      kind: "head" (shines as the camera looks), "directional" or "spot".
      diffuse, ambient, specular: red, green and blue.
      direction: in which it shines, in the world; not of a head light.
      position: of a spot, in the world.
      cutoff: half the angle of a spot's cone in degrees; 180 for a light to all sides.
      exponent: how fast a spot fades from its axis.
    """

    kind: str
    diffuse: Vector
    ambient: Vector = (0.0, 0.0, 0.0)
    specular: Vector = (0.0, 0.0, 0.0)
    direction: Vector = (0.0, 0.0, -1.0)
    position: Vector = (0.0, 0.0, 0.0)
    cutoff: float = 180.0
    exponent: float = 0.0


# MuJoCo's sky is a ball that reaches this share of the depth beyond which it draws nothing.
SKY_RADIUS = 0.5**0.5

HEADLIGHT = Light("head", diffuse=(0.4,) * 3, ambient=(0.1,) * 3, specular=(0.5,) * 3)


@dataclass(frozen=True)
class Camera:
    """Looks at a point from a distance; by default from -y along +y, z upwards.

    Attributes:
      target: the point that is in the middle of the picture, in metres.
      link: the link that it follows.
      follows: along which axes the target is where the link is, instead of as given.
      distance: from the target in metres.
      azimuth, elevation: where it looks, in degrees: azimuth 0 along +x, 90 along +y.
      field_of_view: of the picture's height (and width), in degrees.
      near: depth before which nothing is seen.
      far: distance beyond which all is sky.
    """

    target: Vector = (0.0, 0.0, 0.0)
    link: int = 0
    follows: tuple[bool, bool, bool] = (False, False, False)
    distance: float = 2.0
    azimuth: float = 90.0
    elevation: float = 0.0
    field_of_view: float = 60.0
    near: float = 0.01
    far: float = 50.0

    def axes(self) -> np.ndarray:
        """The directions right, up and forwards in the world, as columns: float64 [3, 3]."""
        azimuth, elevation = math.radians(self.azimuth), math.radians(self.elevation)
        level = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        forwards = math.cos(elevation) * level + [0.0, 0.0, math.sin(elevation)]
        right = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
        return np.stack([right, np.cross(right, forwards), forwards], axis=1)


@dataclass(frozen=True)
class Scene:
    """All that is seen but for where the links are. A constant of a program, and hashable.

    Attributes:
      geometries: G.
      camera: where it is seen from.
      lights: whose parts add up.
      sky: the colour where nothing is.
    """

    geometries: tuple[Geometry, ...]
    camera: Camera = Camera()
    lights: tuple[Light, ...] = (HEADLIGHT,)
    sky: Vector = (1.0, 1.0, 1.0)

    def __post_init__(self):
        if not self.geometries:
            raise ValueError("got a scene without geometries, expected something to draw")

    @property
    def links(self) -> int:
        """The number of links that it speaks of, at most L."""
        used = [geometry.link for geometry in self.geometries]
        return 1 + max(used + [self.camera.link] * any(self.camera.follows))


# MuJoCo's numbers for what can be drawn, and the names of the others.
_KINDS = {0: "plane", 2: "sphere", 3: "capsule", 4: "ellipsoid", 5: "cylinder", 6: "box"}
_OTHERS = {1: "height field", 7: "mesh", 8: "signed distance field"}
_LIGHTS = {0: "spot", 1: "directional", 2: "spot"}
_SKYBOX = 2
_POINT = 2
# MuJoCo draws geometries of groups 0 to 2 unless told otherwise.
_SEEN_GROUPS = 3
# What MuJoCo gives geometries without a colour of their own, and without a material.
_GREY = (0.5, 0.5, 0.5, 1.0)


def scene_of(model: Any, camera: Camera | None = None) -> Scene:
    """The scene of a model, in its own colours and light.

    Geometries of groups 0 to 2 that are not wholly transparent are seen, all of them opaque;
    sites, tendons and shadows are not drawn. A texture counts by its mean colour, except for
    checkers on planes; the sky has the mean colour of the model's, or is black without one.
    Lights stay where they are in the model's initial state.

    Args:
      model: a `brax.System` or a `mujoco.MjModel`.
      camera: by default the one with which MuJoCo's viewer begins, which does not move.

    Raises:
      ValueError: for a model without anything to draw.
      NotImplementedError: for a geometry that cannot be drawn, with its name.
    """
    if hasattr(model, "mj_model"):
        model = model.mj_model
    if model is None or not hasattr(model, "geom_type"):
        raise ValueError(
            f"got {type(model).__name__}, expected a mujoco.MjModel, or a brax.System that holds "
            "one (as those of brax.io.mjcf do)"
        )
    seen = [
        index
        for index in range(model.ngeom)
        if model.geom_group[index] < _SEEN_GROUPS and _rgba(model, index)[3] > 0
    ]
    lights = [_light(model, index) for index in range(model.nlight) if model.light_active[index]]
    head = model.vis.headlight
    if head.active:
        diffuse, ambient, specular = map(_vector, (head.diffuse, head.ambient, head.specular))
        lights.insert(0, Light("head", diffuse, ambient, specular))
    skies = [_sky(model, index) for index in range(model.ntex) if _is_sky(model, index)]
    return Scene(
        geometries=tuple(_geometry(model, index) for index in seen),
        camera=camera or _first_camera(model),
        lights=tuple(lights),
        sky=skies[0] if skies else (0.0, 0.0, 0.0),
    )


def _vector(values) -> Vector:
    x, y, z = map(float, values)
    return x, y, z


def _four(values) -> tuple[float, float, float, float]:
    first, second, third, fourth = map(float, values)
    return first, second, third, fourth


def _rgba(model, index: int) -> tuple[float, float, float, float]:
    own, material = _four(model.geom_rgba[index]), model.geom_matid[index]
    return _four(model.mat_rgba[material]) if material >= 0 and own == _GREY else own


def _geometry(model, index: int) -> Geometry:
    number, material = int(model.geom_type[index]), model.geom_matid[index]
    if number not in _KINDS:
        kind = _OTHERS.get(number, f"geometry of type {number}")
        name = model.geom(index).name or f"number {index}"
        body = model.body(model.geom_bodyid[index]).name
        raise NotImplementedError(
            f"cannot draw the {kind} {name!r} of the body {body!r}: expected {', '.join(KINDS)}. "
            "Give it a group above 2, or the colour's alpha 0, to leave it out"
        )
    kind, size = _KINDS[number], _vector(model.geom_size[index])
    colour, checker, gloss = _rgba(model, index)[:3], None, {}
    if material >= 0:
        gloss = {
            "specular": float(model.mat_specular[material]),
            # The exponent of OpenGL, which MuJoCo's number is a share of.
            "shininess": 128 * float(model.mat_shininess[material]),
        }
        texture = int(np.ravel(model.mat_texid[material])[_RGB])
        if texture >= 0:
            pixels = _texture(model, texture)
            fields = _fields(pixels) if kind == "plane" else None
            if fields is None:
                colour = _vector(np.multiply(colour, _mean(pixels)))
            else:
                # Textures begin at a corner of the plane, or in the middle of an endless one.
                corner = (-size[0], size[1])
                checker = Checker(fields, _field_widths(model, material, size), corner)
    return Geometry(
        kind=kind,
        size=size,
        colour=colour,
        link=int(model.geom_bodyid[index]) - 1,
        position=_vector(model.geom_pos[index]),
        rotation=_four(model.geom_quat[index]),
        checker=checker,
        **gloss,
    )


def _light(model, index: int) -> Light:
    number = int(model.light_type[index])
    if number not in _LIGHTS:
        raise NotImplementedError(
            f"cannot draw the light {model.light(index).name or index!r} of type {number}: "
            "expected a spot, a directional or a point light"
        )
    return Light(
        kind=_LIGHTS[number],
        diffuse=_vector(model.light_diffuse[index]),
        ambient=_vector(model.light_ambient[index]),
        specular=_vector(model.light_specular[index]),
        direction=_vector(model.light_dir0[index]),
        position=_vector(model.light_pos0[index]),
        cutoff=180.0 if number == _POINT else float(model.light_cutoff[index]),
        exponent=0.0 if number == _POINT else float(model.light_exponent[index]),
    )


def _first_camera(model) -> Camera:
    view, extent = model.vis.global_, float(model.stat.extent)
    return Camera(
        target=_vector(model.stat.center),
        distance=1.5 * extent,
        azimuth=float(view.azimuth),
        elevation=float(view.elevation),
        field_of_view=float(view.fovy),
        near=float(model.vis.map.znear) * extent,
        far=SKY_RADIUS * float(model.vis.map.zfar) * extent,
    )


# Textures

# Where the number of the texture that gives a material's colour stands.
_RGB = 1


def _is_sky(model, index: int) -> bool:
    return int(model.tex_type[index]) == _SKYBOX


def _sky(model, index: int) -> Vector:
    """The mean colour of the sides of a sky box; what is above and below is seldom seen."""
    pixels = _texture(model, index)
    faces = np.split(pixels, 6) if len(pixels) == 6 * pixels.shape[1] else [pixels]
    return _mean(np.concatenate([*faces[:2], *faces[4:]]))


def _texture(model, index: int) -> np.ndarray:
    """The pixels, float64 [height, width, 3] in [0, 1]."""
    height, width = int(model.tex_height[index]), int(model.tex_width[index])
    channels, start = int(model.tex_nchannel[index]), int(model.tex_adr[index])
    pixels = model.tex_data[start : start + height * width * channels]
    pixels = np.asarray(pixels, np.float64).reshape(height, width, channels) / 255
    return np.repeat(pixels, 3, axis=2) if channels == 1 else pixels[..., :3]


def _mean(pixels: np.ndarray) -> Vector:
    return _vector(pixels.mean((0, 1)))


def _fields(pixels: np.ndarray) -> tuple[Vector, Vector] | None:
    """The two colours of a texture of 2 x 2 fields, None of another."""
    rows, columns = pixels.shape[0] // 2, pixels.shape[1] // 2
    parts = [pixels[:rows, columns:], pixels[:rows, :columns]]
    parts += [pixels[rows:, :columns], pixels[rows:, columns:]]
    colours = [_mean(part) for part in parts]
    flat = all(np.ptp(part, axis=(0, 1)).max() < 1 / 64 for part in parts)
    if flat and np.allclose(colours[:2], colours[2:], atol=1 / 64):
        return colours[0], colours[1]
    return None


def _field_widths(model, material: int, size: Vector) -> tuple[float, float]:
    """Widths along x and y of one of a texture's 2 x 2 fields on a plane, in metres."""
    repeats = model.mat_texrepeat[material]

    def width(half: float, repeat: float) -> float:
        endless = model.mat_texuniform[material] or half == 0
        return float((1.0 if endless else half) / repeat)

    return width(size[0], repeats[0]), width(size[1], repeats[1])
