"""The tasks as gymnasium environments, for agents other than those of this repository."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from envs.base import LEAST_SIZE, TaskSpec, check_whole
from envs.wrappers import ActionRepeat, TimeLimit, make_simulator


class PixelEnv(gymnasium.Env):
    """One simulator in this process; observations are its images, actions are in [-1, 1].

    Observations are uint8 [image_size, image_size, 3], actions float32 [|A|]. An episode is
    terminated by falling and truncated after the task's time limit, which counts environment
    steps, not actions. `reset(seed=...)` makes the simulator anew, so that what follows depends
    on the seed alone, to the bit; `reset()` starts the next episode in the same one.

    Args:
      task: which task.
      image_size: height and width of the images in pixels.
      action_repeat: environment steps for which an action is held, whose rewards are summed;
        by default the task's.
      render_mode: "rgb_array" to have `render` return the picture of the present state.

    Raises:
      ValueError: for an image size that is none, or below 8 for Brax's tasks.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(
        self,
        task: TaskSpec,
        image_size: int = 64,
        action_repeat: int | None = None,
        render_mode: str | None = None,
    ):
        least = LEAST_SIZE if task.name.startswith("brax/") else 1
        check_whole("an image size of ", image_size, least)
        self._task = task
        self._image_size = image_size
        self._action_repeat = task.action_repeat if action_repeat is None else action_repeat
        self._simulator: ActionRepeat | None = None
        self.render_mode = render_mode
        frames_per_second = round(1 / (task.step_seconds * self._action_repeat))
        self.metadata = self.metadata | {"render_fps": max(1, frames_per_second)}
        self.observation_space = gymnasium.spaces.Box(0, 255, (image_size, image_size, 3), np.uint8)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (task.action_size,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; returns its first image and an empty dictionary."""
        super().reset(seed=seed)
        if seed is not None:
            self.close()
        if self._simulator is None:
            simulator = make_simulator(self._task, self._image_size)
            self._simulator = ActionRepeat(
                TimeLimit(simulator, self._task.time_limit), self._action_repeat
            )
        self._simulator.reset(int(self.np_random.integers(2**63)))
        return self._simulator.render(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold `action` for the action repeat; returns the image after it.

        Raises:
          ValueError: if the action is not finite.
        """
        if self._simulator is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        if not np.isfinite(action).all():
            raise ValueError(f"{self._task.name} got an action that is not finite: {action}")
        reward, terminal, truncated = self._simulator.step(action)
        return self._simulator.render(), reward, terminal, truncated, {}

    def render(self) -> np.ndarray | None:
        """The picture of the present state, uint8 [image_size, image_size, 3]."""
        if self.render_mode is None:
            return None
        if self._simulator is None:
            raise gymnasium.error.ResetNeeded("call reset before render")
        return self._simulator.render()

    def close(self) -> None:
        """Free the simulator; a `reset` afterwards makes a new one."""
        if self._simulator is not None:
            self._simulator.close()
            self._simulator = None
