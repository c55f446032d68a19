"""Gymnasium environments that do everything wrong. Importing this registers their ids.

Each must be told as the project's own error, with its task and slot and, where code raised, its
traceback.
"""

import os
import time

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete


class TwoArguments(Exception):
    """Cannot be pickled: its arguments are not those it is made with."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


class Quiet(gymnasium.Env):
    """An environment in order; others change one thing."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    observation_space, action_space = Box(-1, 1, (2,), np.float32), Discrete(2)

    def __init__(self, render_mode=None):
        self.render_mode, self.steps = render_mode, 0

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(2, np.float32), self.reward(), False, False, {}

    def reward(self):
        return 1.0

    def render(self):
        return np.full((8, 8, 3), self.steps % 256, np.uint8)


def raising(error):
    def call(self, *_, **__):
        raise error

    return call


def local_error():
    class Local(Exception):
        pass

    return Local("of a class inside a function")


def later(value, step=3):
    """A reward that is in order up to some step."""
    return lambda self: value if self.steps >= step else 1.0


def after(action, step=3):
    """A step that does something at last."""

    def call(self, _):
        self.steps += 1
        if self.steps >= step:
            action()
        return np.zeros(2, np.float32), 1.0, False, False, {}

    return call


def image(value):
    return {"render": lambda self: value}


HOSTILE = {
    "raises in its making": {"__init__": raising(TwoArguments("one", "two"))},
    "raises in reset": {"reset": raising(TwoArguments("one", "two"))},
    "raises a local class": {"reset": raising(local_error())},
    "exits in reset": {"reset": raising(SystemExit(3))},
    "raises in step": {"step": raising(TwoArguments("one", "two"))},
    "raises in render": {"render": raising(local_error())},
    "renders nothing": image(None),
    "has no render": {"render": None},
    "renders floats": image(np.zeros((8, 8, 3))),
    "renders NaN": image(np.full((8, 8, 3), np.nan)),
    "renders four channels": image(np.zeros((8, 8, 4), np.uint8)),
    "renders no pixels": image(np.zeros((0, 0, 3), np.uint8)),
    "renders a line": image(np.zeros(8, np.uint8)),
    "renders text": image("a picture"),
    "rewards with NaN": {"reward": later(float("nan"))},
    "rewards with infinity": {"reward": later(float("inf"))},
    "rewards too much": {"reward": later(1e300)},
    "rewards with a list": {"reward": later([1.0, 2.0])},
    "rewards with None": {"reward": later(None)},
    "rewards with text": {"reward": later("much")},
    "ends its process": {"step": after(lambda: os._exit(7))},
    "hangs": {"step": after(lambda: time.sleep(600))},
}
"""What each one does wrong."""

SLOW = ("hangs",)


def identifier(name: str) -> str:
    """The id for `gymnasium.make` of one of them, or of "in order"."""
    return f"Hostile/{''.join(word.capitalize() for word in name.split())}-v0"


for _name, _changes in {**HOSTILE, "in order": {}}.items():
    gymnasium.register(identifier(_name), type("Hostile", (Quiet,), _changes))


def play(name: str, ticks: int = 6, timeout: float = 300.0) -> str | None:
    """Plays one of them beside one in order, as a run does.

    Returns:
      What is told; None if nothing is.
    """
    import envs
    from envs.pool import SimulatorPool

    ids = [identifier("in order"), identifier(name)]
    try:
        tasks = [envs.spec(f"gymnasium/tests.faults.hostile:{id}") for id in ids]
        pool = SimulatorPool(tasks, 8, 2, 1, workers=1, timeout=timeout)
    except (envs.SimulatorError, ValueError, ModuleNotFoundError) as error:
        return str(error)
    try:
        slots = np.arange(2)
        pool.reset(slots, np.zeros((2, 2), np.uint32))
        for _ in range(ticks):
            pool.step(slots, np.eye(2, dtype=np.float32))
    except envs.SimulatorError as error:
        return str(error)
    finally:
        pool.close()
    return None


def is_clear(name: str, said: str | None) -> bool:
    """Whether what is told names the task, and the slot once simulators have slots."""
    return said is not None and identifier(name) in said
