"""Simulators whose every output can be worked out by hand, to test what hosts them."""

import os

import numpy as np

from envs.base import Outcome


class Counting:
    """Step k gives reward sum(action) and a picture full of k; the seed is its first pixel.

    Falls on the third step of an episode if its title says so.
    """

    def __init__(self, title: str, image_size: int):
        self._falls = title == "Falling"
        self._image_size = image_size
        self._seed = 0
        self._steps = 0

    def reset(self, seed: int) -> None:
        self._seed, self._steps = seed, 0

    def step(self, action: np.ndarray) -> Outcome:
        self._steps += 1
        return Outcome(float(np.sum(action)), self._falls and self._steps == 3)

    def render(self) -> np.ndarray:
        image = np.full((self._image_size, self._image_size, 3), self._steps % 256, np.uint8)
        image[0, 0] = [self._seed >> shift & 255 for shift in (0, 8, 16)]
        return image

    def close(self) -> None:
        pass


class Failing(Counting):
    """Raises on its second step."""

    def step(self, action: np.ndarray) -> Outcome:
        if self._steps == 1:
            raise ArithmeticError("the contact solver diverged")
        return super().step(action)


class Dying(Counting):
    """Takes its whole process with it on its second step, with a last word."""

    def step(self, action: np.ndarray) -> Outcome:
        if self._steps == 1:
            os.write(2, b"corrupted contact list\n")
            os._exit(7)
        return super().step(action)
