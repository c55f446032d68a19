"""The six PyBullet tasks of the thesis (section 4.1) as simulators with a camera.

Bodies and rewards are those of the package `pybullet_envs_gymnasium`, except for the double
pendulum, whose swing-up variant is defined here (thesis, equation 25).
"""

from __future__ import annotations

import os

import numpy as np

from envs.base import Outcome

try:
    import pybullet
    from pybullet_envs_gymnasium import gym_locomotion_envs, gym_pendulum_envs, robot_pendula
    from pybullet_utils.bullet_client import BulletClient
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"The bullet/ tasks need the package {error.name!r}, which is not installed: "
        "pip install 'dreamer-transfer[bullet]' (PyBullet has wheels up to Python 3.11 and is "
        "built from source on later ones)."
    ) from error


class _Client(BulletClient):
    """A physics engine of its own, in this process.

    The base class would first look for the engine of another process in shared memory, and
    prints the options it passes on.
    """

    def __init__(self):
        self._shapes = {}
        self._pid = os.getpid()
        self._client = pybullet.connect(pybullet.DIRECT)


class _DoublePendulumHanging(robot_pendula.InvertedDoublePendulum):
    """The double pendulum, hanging straight down but for a small random angle of each joint."""

    def robot_specific_reset(self, bullet_client):
        super().robot_specific_reset(bullet_client)
        random: np.random.Generator = self.np_random  # type: ignore[attr-defined]
        hinge_offset, hinge2_offset = random.uniform(low=-0.1, high=0.1, size=2)
        self.j1.reset_current_position(float(np.pi + hinge_offset), 0)
        self.j2.reset_current_position(float(hinge2_offset), 0)
        self.j1.set_motor_torque(0)
        self.j2.set_motor_torque(0)


class InvertedDoublePendulumSwingup(gym_pendulum_envs.InvertedDoublePendulumBulletEnv):
    """Swing a double pendulum up: reward cos(hinge) + cos(hinge2), never terminal (eq. 25).

    The angles are the joints' positions as the simulator gives them, so the second is relative
    to the first pole: hanging straight down is worth 0, balancing upright 2.
    """

    def __init__(self, render_mode=None):
        super().__init__(render_mode)
        self.robot = _DoublePendulumHanging()
        self.seed()

    def step(self, action):
        state, _, _, truncated, info = super().step(action)
        hinge, _ = self.robot.j1.current_position()
        hinge2, _ = self.robot.j2.current_position()
        return state, float(np.cos(hinge) + np.cos(hinge2)), False, truncated, info


_PHYSICS = {
    "Ant": gym_locomotion_envs.AntBulletEnv,
    "HalfCheetah": gym_locomotion_envs.HalfCheetahBulletEnv,
    "Hopper": gym_locomotion_envs.HopperBulletEnv,
    "Walker2D": gym_locomotion_envs.Walker2DBulletEnv,
    "InvertedPendulum": gym_pendulum_envs.InvertedPendulumSwingupBulletEnv,
    "InvertedDoublePendulum": InvertedDoublePendulumSwingup,
}
_PENDULA = ("InvertedPendulum", "InvertedDoublePendulum")

# PyBullet numbers bodies in loading order. Body 1 is the robot of a locomotion task, the cart of
# the pendulum and the rail of the double pendulum; the base of neither of the last two moves.
_CAMERA_BODY = 1


class BulletSimulator:
    """One of the six tasks, with the camera that the author of the thesis used.

    A new simulator holds nothing until its first `reset`, which depends on the seed alone and
    takes about 20 ms; later resets are made in place, in a millisecond at most. They put every
    joint back but keep the solver's history, so they are reproducible only together with all
    that this simulator did before.

    Args:
      title: one of the six names of the thesis, such as "Walker2D".
      image_size: height and width of the rendered images in pixels.
    """

    def __init__(self, title: str, image_size: int):
        self._env = _PHYSICS[title]()
        self._follow_link = title not in _PENDULA
        self._image_size = image_size
        self._projection = pybullet.computeProjectionMatrixFOV(
            fov=60, aspect=1.0, nearVal=1.0, farVal=25.0
        )

    def reset(self, seed: int) -> None:
        """Start an episode with joint angles drawn from `seed` (any non-negative integer)."""
        if self._env.physicsClientId < 0:
            self._connect()
        self._env.reset(seed=seed)

    def _connect(self) -> None:
        client = _Client()
        client.resetSimulation()
        client.setPhysicsEngineParameter(deterministicOverlappingPairs=1)
        self._env._p = client
        self._env.physicsClientId = client._client
        self._env.ownsPhysicsClient = True

    def step(self, action: np.ndarray) -> Outcome:
        """Advance by one environment step (16.5 ms of simulated time)."""
        # Clipped here, since the package clips torques but not the cost of electricity.
        clipped = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        _, reward, terminal, _, _ = self._env.step(clipped)
        return Outcome(float(reward), bool(terminal))

    def render(self) -> np.ndarray:
        """The present picture, uint8 [image_size, image_size, 3], white where nothing is."""
        client, size = self._env._p, self._image_size
        if self._follow_link:
            target = client.getLinkState(_CAMERA_BODY, 0)[0]
        else:
            target = client.getBasePositionAndOrientation(_CAMERA_BODY)[0]
        view = client.computeViewMatrixFromYawPitchRoll(
            cameraTargetPosition=target, distance=2, yaw=0, pitch=0, roll=0, upAxisIndex=2
        )
        pixels = client.getCameraImage(
            width=size,
            height=size,
            viewMatrix=view,
            projectionMatrix=self._projection,
            shadow=1,
            lightDirection=[0, 1, 1],
            renderer=pybullet.ER_TINY_RENDERER,
        )[2]
        rgba = np.asarray(pixels, np.uint8).reshape(size, size, 4)
        # A pixel is one word: choosing among words takes a quarter of the time of choosing bytes.
        words = np.where(rgba[..., 3] == 0, np.uint32(0xFFFFFFFF), rgba.view(np.uint32)[..., 0])
        return np.ascontiguousarray(words.view(np.uint8).reshape(size, size, 4)[..., :3])

    def close(self) -> None:
        """Disconnect from the physics engine."""
        self._env.close()
