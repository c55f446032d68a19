"""Simulators made for tests: most have outputs that can be worked out by hand."""

import os
import sys
import time

import numpy as np

from envs.base import Outcome


class Counting:
    """Step k gives reward sum(action) and a picture full of k; its first pixel is the seed's."""

    def __init__(self, title: str, image_size: int):
        self._image_size = image_size
        self._seed = 0
        self._steps = 0

    def reset(self, seed: int) -> None:
        self._seed, self._steps = seed, 0

    def step(self, action: np.ndarray) -> Outcome:
        self._steps += 1
        return Outcome(float(np.sum(action)), False)

    def render(self) -> np.ndarray:
        image = np.full((self._image_size, self._image_size, 3), self._steps % 256, np.uint8)
        image[0, 0] = [self._seed >> shift & 255 for shift in (0, 8, 16)]
        return image

    def close(self) -> None:
        pass


class Falling(Counting):
    """Counting, but every third step is a fall."""

    def step(self, action: np.ndarray) -> Outcome:
        return super().step(action)._replace(terminal=self._steps % 3 == 0)


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


class Orphaning(Counting):
    """Dies on its first step, and leaves a process that holds whatever was open for a while."""

    def step(self, action: np.ndarray) -> Outcome:
        if os.fork() == 0:
            time.sleep(20)
        os._exit(7)


class Slow(Counting):
    """Takes a third of a second for a step."""

    seconds = 0.3

    def step(self, action: np.ndarray) -> Outcome:
        time.sleep(self.seconds)
        return super().step(action)


class Stuck(Slow):
    """Takes a minute for a step."""

    seconds = 60


class Modules(Counting):
    """Its reward is the number of loaded modules of JAX."""

    def step(self, action: np.ndarray) -> Outcome:
        loaded = [name for name in sys.modules if name.partition(".")[0] in ("jax", "jaxlib")]
        return Outcome(float(len(loaded)), False)


def falling_bullet(title: str, image_size: int):
    """A PyBullet task in which every 20th step counts as a fall, whatever the body does."""
    from envs.bullet import BulletSimulator

    class FallingBullet(BulletSimulator):
        steps = 0

        def step(self, action: np.ndarray) -> Outcome:
            self.steps += 1
            outcome = super().step(action)
            return outcome._replace(terminal=outcome.terminal or self.steps % 20 == 0)

    return FallingBullet(title, image_size)
