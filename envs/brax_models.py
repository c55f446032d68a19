"""What Brax's six tasks look like: models, colours and camera, for every renderer. Imports no JAX.

Colours and camera are those of the PyBullet tasks (`envs.bullet`): from two metres along -y at the
same target, 60 degrees wide, a white sky, and limbs told apart by their colours.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from envs.scene import SKY_RADIUS, Camera


def not_installed(missing: str | None) -> ModuleNotFoundError:
    """The error of whoever finds a package of the tasks missing."""
    return ModuleNotFoundError(
        f"The brax/ tasks need the package {missing!r}, which is not installed: "
        "pip install 'dreamer-transfer[brax]'.",
        name=missing,
    )


@dataclass(frozen=True)
class _Look:
    """How a task is drawn.

    Attributes:
      file: of Brax's model.
      colours: of the bodies, in the model's order: those that PyBullet gives them.
      target: height at which the camera looks; None for that of the first body.
    """

    file: str
    colours: str
    target: float | None


_LOOKS = {
    "Ant": _Look("ant", "gyrgrbybgrgyb", None),
    "HalfCheetah": _Look("half_cheetah", "gybybyb", 0.7),
    "Hopper": _Look("hopper", "gyby", 0.0),
    "Walker2D": _Look("walker2d", "gybybyb", 0.0),
    "InvertedPendulum": _Look("inverted_pendulum", "gb", 0.0),
    "InvertedDoublePendulum": _Look("inverted_double_pendulum", "gby", 0.0),
}
_COLOURS = {
    "g": "0.23 0.73 0.33",
    "y": "0.95 0.76 0.05",
    "b": "0.28 0.52 0.93",
    "r": "0.86 0.20 0.21",
}
# Depth in metres from which on PyBullet's camera sees, and to which MuJoCo draws.
NEAR, DEPTH = 1.0, 25.0


def camera(title: str) -> Camera:
    """The camera of a task. It goes along with a walker, and stays where a pendulum's rail is."""
    walks, height = "Pendulum" not in title, _LOOKS[title].target
    return Camera(
        target=(0.0, 0.0, height or 0.0),
        follows=(walks, walks, height is None),
        near=NEAR,
        far=DEPTH * SKY_RADIUS,
    )


def model_xml(title: str) -> str:
    """Brax's model of a task; the pendula's hinges may turn all the way round.

    Raises:
      ModuleNotFoundError: if Brax is not installed.
    """
    brax = importlib.util.find_spec("brax")
    if brax is None or not brax.submodule_search_locations:
        raise not_installed("brax")
    assets = Path(brax.submodule_search_locations[0], "envs/assets")
    root = ElementTree.parse(assets / f"{_LOOKS[title].file}.xml").getroot()
    if "Pendulum" in title:
        for joint in root.iter("joint"):
            if joint.get("type") == "hinge":
                joint.set("limited", "false")
                joint.attrib.pop("range", None)
    return ElementTree.tostring(root, encoding="unicode")


def painted_xml(title: str) -> str:
    """The model in the colours of the PyBullet tasks, under a white sky."""
    root = ElementTree.fromstring(model_xml(title))
    for compiler in root.findall("compiler"):
        compiler.attrib.pop("settotalmass", None)  # deprecated, and of no weight here
    for geom in root.iter("geom"):
        if geom.get("material") == "geom":
            del geom.attrib["material"]
    for body, colour in zip(root.iter("body"), _LOOKS[title].colours, strict=True):
        for geom in body.findall("geom"):
            geom.set("rgba", f"{_COLOURS[colour]} 1")
    for geom in root.findall("worldbody/geom"):
        colour = "1 1 1" if geom.get("material") else _COLOURS["g"]
        geom.set("rgba", f"{colour} 1")
    assets = root.find("asset")
    assets = ElementTree.SubElement(root, "asset") if assets is None else assets
    for element in list(assets):
        if element.get("type") in ("skybox", "cube") or element.get("name") == "geom":
            assets.remove(element)
        elif element.get("type") == "2d":
            element.set("rgb1", "0.83 0.83 0.83")
            element.set("rgb2", "0.55 0.64 0.82")
    sky = dict(type="skybox", builtin="flat", rgb1="1 1 1", width="4", height="4")
    ElementTree.SubElement(assets, "texture", sky)
    return ElementTree.tostring(root, encoding="unicode")
