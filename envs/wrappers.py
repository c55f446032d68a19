"""Small simulators around a simulator: action repeat, time limit, action padding."""

from __future__ import annotations

import pkgutil

import numpy as np

from envs.base import Outcome, Simulator, TaskSpec


class SimulatorWrapper:
    """Passes everything on to another simulator; subclasses change what they need to."""

    def __init__(self, simulator: Simulator):
        self._simulator = simulator

    def reset(self, seed: int) -> None:
        self._simulator.reset(seed)

    def step(self, action: np.ndarray) -> Outcome:
        return self._simulator.step(action)

    def render(self) -> np.ndarray:
        return self._simulator.render()

    def close(self) -> None:
        self._simulator.close()


class ActionRepeat(SimulatorWrapper):
    """Holds each action for `repeat` environment steps, fewer if the episode ends, and sums
    their rewards."""

    def __init__(self, simulator: Simulator, repeat: int):
        super().__init__(simulator)
        self._repeat = repeat

    def step(self, action: np.ndarray) -> Outcome:
        reward = 0.0
        for _ in range(self._repeat):
            outcome = self._simulator.step(action)
            reward += outcome.reward
            if outcome.terminal or outcome.truncated:
                break
        return outcome._replace(reward=reward)


class TimeLimit(SimulatorWrapper):
    """Truncates an episode after `limit` environment steps (inside of any action repeat)."""

    def __init__(self, simulator: Simulator, limit: int):
        super().__init__(simulator)
        self._limit = limit
        self._steps = 0

    def reset(self, seed: int) -> None:
        self._steps = 0
        super().reset(seed)

    def step(self, action: np.ndarray) -> Outcome:
        self._steps += 1
        outcome = super().step(action)
        return outcome._replace(truncated=outcome.truncated or self._steps >= self._limit)


class Supersampling(SimulatorWrapper):
    """Averages pictures that are drawn `factor` times as large, so that edges turn grey where
    they would jump from pixel to pixel."""

    def __init__(self, simulator: Simulator, factor: int):
        super().__init__(simulator)
        self._factor = factor

    def render(self) -> np.ndarray:
        return averaged(super().render(), self._factor)


def averaged(image: np.ndarray, factor: int) -> np.ndarray:
    """The mean of each `factor` x `factor` block of pixels, rounded half up:
    uint8 [height * factor, width * factor, 3] -> uint8 [height, width, 3]."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    # Whole arrays are added up: NumPy's reduction over axes this short takes ten times as long.
    rows = image.reshape(height, factor, width * factor, 3)
    lines = rows[:, 0].astype(np.uint32)
    for i in range(1, factor):
        lines += rows[:, i]
    columns = lines.reshape(height, width, factor, 3)
    total = columns[:, :, 0].copy()
    for i in range(1, factor):
        total += columns[:, :, i]
    area = factor * factor
    return ((total + area // 2) // area).astype(np.uint8)


def make_simulator(task: TaskSpec, image_size: int) -> Simulator:
    """The simulator of a task, with pictures of that size."""
    make = pkgutil.resolve_name(task.simulator)
    if task.supersample == 1:
        return make(task.title, image_size)
    return Supersampling(make(task.title, image_size * task.supersample), task.supersample)


class ActionPadding(SimulatorWrapper):
    """Takes actions padded to a common length A, of which the first `action_size` count."""

    def __init__(self, simulator: Simulator, action_size: int):
        super().__init__(simulator)
        self._action_size = action_size

    def step(self, action: np.ndarray) -> Outcome:
        return super().step(action[: self._action_size])
