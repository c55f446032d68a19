"""Pictures of Brax's six tasks, drawn by MuJoCo from joint positions alone. Imports no JAX.

The camera is that of the PyBullet tasks (`envs.bullet`): from two metres along -y at the same
target, 60 degrees wide, a white sky, and limbs told apart by their colours.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import subprocess
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from envs.base import Outcome, SimulatorError

NEEDED = (
    "Brax's pictures are drawn by MuJoCo, which needs EGL or OSMesa (with or without a graphics "
    "card). On Debian: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri (EGL) or libosmesa6 "
    "(OSMesa). MUJOCO_GL=egl or MUJOCO_GL=osmesa chooses one."
)
_PROBE = "import mujoco; mujoco.GLContext(8, 8).make_current()"


def choose_gl() -> None:
    """Set MUJOCO_GL to what draws here without a display, unless it is set: EGL, then OSMesa.

    MuJoCo reads it once, as it is imported, and a driver that fails may take its process with it;
    hence each is tried in a process of its own.
    """
    if "MUJOCO_GL" in os.environ or not sys.platform.startswith("linux"):
        return
    for name in ("egl", "osmesa"):
        environment = os.environ | {"MUJOCO_GL": name}
        probe = [sys.executable, "-c", _PROBE]
        if subprocess.run(probe, env=environment, capture_output=True).returncode == 0:
            os.environ["MUJOCO_GL"] = name
            return


try:
    if importlib.util.find_spec("mujoco") is not None:
        choose_gl()
    import mujoco

    _ASSETS = Path(importlib.util.find_spec("brax").submodule_search_locations[0], "envs/assets")
except (ModuleNotFoundError, AttributeError) as error:
    missing = getattr(error, "name", None) or "brax"
    raise ModuleNotFoundError(
        f"The brax/ tasks need the package {missing!r}, which is not installed: "
        "pip install 'dreamer-transfer[brax]'.",
        name=missing,
    ) from error

# Left to itself, MuJoCo writes its warnings to a file in the current folder.
mujoco.set_mju_user_warning(warnings.warn)


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


def model_xml(title: str) -> str:
    """Brax's model of a task; the pendula's hinges may turn all the way round."""
    root = ElementTree.parse(_ASSETS / f"{_LOOKS[title].file}.xml").getroot()
    if "Pendulum" in title:
        for joint in root.iter("joint"):
            if joint.get("type") == "hinge":
                joint.set("limited", "false")
                joint.attrib.pop("range", None)
    return ElementTree.tostring(root, encoding="unicode")


def _painted(title: str) -> str:
    """The model in the colours of the PyBullet tasks, under a white sky."""
    root = ElementTree.fromstring(model_xml(title))
    root.find("compiler").attrib.pop("settotalmass", None)  # deprecated, and of no weight here
    for geom in root.iter("geom"):
        if geom.get("material") == "geom":
            del geom.attrib["material"]
    for body, colour in zip(root.iter("body"), _LOOKS[title].colours, strict=True):
        for geom in body.findall("geom"):
            geom.set("rgba", f"{_COLOURS[colour]} 1")
    world = root.find("worldbody")
    for geom in world.findall("geom"):
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


class Pictures:
    """Draws one task, for one thread: a renderer and its OpenGL context, kept.

    Args:
        title: one of the six names of the thesis, such as "Walker2D".
        image_size: height and width of the pictures in pixels.

    Raises:
        SimulatorError: if there is nothing to draw with, and what to install.
    """

    def __init__(self, title: str, image_size: int):
        model = mujoco.MjModel.from_xml_string(_painted(title))
        # Frames of 64 x 64 take 0.4 to 3 ms without these, and 20 to 80 with them.
        model.vis.quality.offsamples = 0
        model.vis.quality.shadowsize = 0
        model.vis.global_.offwidth = model.vis.global_.offheight = image_size
        model.vis.global_.fovy = 60
        model.stat.extent = 1.0
        model.vis.map.znear, model.vis.map.zfar = 1.0, 25.0
        self._model, self._data = model, mujoco.MjData(model)
        self._target = _LOOKS[title].target
        try:
            self._renderer = mujoco.Renderer(model, image_size, image_size)
        except Exception as error:  # each of OpenGL's platforms has errors of its own
            chosen = os.environ.get("MUJOCO_GL", "(not set)")
            raise SimulatorError(f"MUJOCO_GL={chosen} does not work: {error}\n{NEEDED}") from error
        for flag in ("SHADOW", "REFLECTION", "HAZE"):
            self._renderer.scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = False
        self._camera = mujoco.MjvCamera()
        self._camera.distance, self._camera.azimuth, self._camera.elevation = 2.0, 90.0, 0.0

    @property
    def positions(self) -> np.ndarray:
        """The model's joint positions at rest, float64 [Q]."""
        return self._model.qpos0

    def draw(self, positions: np.ndarray) -> np.ndarray:
        """The picture of joint positions, float [Q]: uint8 [image_size, image_size, 3]."""
        model, data = self._model, self._data
        data.qpos[:] = positions
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        x, y, z = data.xpos[1]
        # The pendula's camera stays where it is.
        moving = model.nq > 3
        self._camera.lookat = [
            x if moving else 0.0,
            y if moving else 0.0,
            z if self._target is None else self._target,
        ]
        self._renderer.update_scene(data, self._camera)
        return self._renderer.render()


@functools.cache
def pictures(title: str, image_size: int) -> Pictures:
    """One `Pictures` for all who draw this task in this process: a context costs more than a
    thousand frames."""
    return Pictures(title, image_size)


class Drawing:
    """What a simulator process hosts for a Brax task: its "action" is the joint positions [Q] that
    the physics has come to, its picture what they look like."""

    def __init__(self, title: str, image_size: int):
        self._pictures = pictures(title, image_size)
        self._positions = self._pictures.positions

    def reset(self, seed: int) -> None:
        """Back to the model's joint positions at rest."""
        self._positions = self._pictures.positions

    def step(self, action: np.ndarray) -> Outcome:
        """Take joint positions [Q]."""
        self._positions = np.array(action, np.float64)
        return Outcome(0.0, False)

    def render(self) -> np.ndarray:
        """The picture, uint8 [image_size, image_size, 3]."""
        return self._pictures.draw(self._positions)

    def close(self) -> None:
        """Nothing: the renderer is kept for others."""
