"""Small simulators around a simulator: action repeat, time limit, action padding."""

from __future__ import annotations

import numpy as np

from envs.base import Outcome, Simulator


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


class ActionPadding(SimulatorWrapper):
    """Takes actions padded to a common length A, of which the first `action_size` count."""

    def __init__(self, simulator: Simulator, action_size: int):
        super().__init__(simulator)
        self._action_size = action_size

    def step(self, action: np.ndarray) -> Outcome:
        return super().step(action[: self._action_size])
