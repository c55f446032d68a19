"""Pictures of Brax's six tasks, drawn by MuJoCo from joint positions alone. Imports no JAX."""

from __future__ import annotations

import functools
import importlib.util
import os
import subprocess
import sys
import warnings

import numpy as np

from envs.base import Outcome, SimulatorError
from envs.brax_models import DEPTH, NEAR, camera, not_installed, painted_xml

NEEDED = (
    "MuJoCo draws through EGL or OSMesa (with or without a graphics card). On Debian: "
    "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri (EGL) or libosmesa6 (OSMesa). "
    "MUJOCO_GL=egl or MUJOCO_GL=osmesa chooses one. Tasks without ':mujoco' in their name need "
    "none of this."
)
_PROBE = "import mujoco; mujoco.GLContext(8, 8).make_current()"
_CONTEXTS = "mujoco.rendering.classic.gl_context"


def choose_gl() -> None:
    """Set MUJOCO_GL to what draws here without a display, unless it is set: EGL, then OSMesa.

    MuJoCo reads it as it is imported, and a driver that fails may take its process with it; hence
    each is tried in a process of its own.
    """
    if "MUJOCO_GL" in os.environ or not sys.platform.startswith("linux"):
        return
    for name in ("egl", "osmesa"):
        environment = os.environ | {"MUJOCO_GL": name}
        probe = [sys.executable, "-c", _PROBE]
        if subprocess.run(probe, env=environment, capture_output=True).returncode == 0:
            os.environ["MUJOCO_GL"] = name
            # Brax imports MuJoCo too, maybe before anyone wanted to draw with it.
            if _CONTEXTS in sys.modules:
                importlib.reload(sys.modules[_CONTEXTS])
            return


try:
    if importlib.util.find_spec("mujoco") is not None:
        choose_gl()
    import mujoco
except ModuleNotFoundError as error:
    raise not_installed(error.name) from error

# Left to itself, MuJoCo writes its warnings to a file in the current folder.
mujoco.set_mju_user_warning(warnings.warn)


class Pictures:
    """Draws one task, for one thread: a renderer and its OpenGL context, kept.

    Args:
      title: one of the six names of the thesis, such as "Walker2D".
      image_size: height and width of the pictures in pixels.

    Raises:
      SimulatorError: if there is nothing to draw with, and what to install.
    """

    def __init__(self, title: str, image_size: int):
        model = mujoco.MjModel.from_xml_string(painted_xml(title))
        # Frames of 64 x 64 take 0.4 to 3 ms without these, and 20 to 80 with them.
        model.vis.quality.offsamples = 0
        model.vis.quality.shadowsize = 0
        model.vis.global_.offwidth = model.vis.global_.offheight = image_size
        self._view = camera(title)
        model.vis.global_.fovy = self._view.field_of_view
        model.stat.extent = 1.0
        model.vis.map.znear, model.vis.map.zfar = NEAR, DEPTH
        self._model, self._data = model, mujoco.MjData(model)
        try:
            self._renderer = mujoco.Renderer(model, image_size, image_size)
        except Exception as error:  # each of OpenGL's platforms has errors of its own
            chosen = os.environ.get("MUJOCO_GL", "(not set)")
            raise SimulatorError(f"MUJOCO_GL={chosen} does not work: {error}\n{NEEDED}") from error
        for flag in ("SHADOW", "REFLECTION", "HAZE"):
            self._renderer.scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = False
        self._camera = mujoco.MjvCamera()
        self._camera.distance = self._view.distance
        self._camera.azimuth = self._view.azimuth
        self._camera.elevation = self._view.elevation

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
        body = data.xpos[1 + self._view.link]
        self._camera.lookat = np.where(self._view.follows, body, self._view.target)
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
