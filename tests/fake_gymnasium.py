"""Gymnasium environments made for tests. Importing this registers their ids."""

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiDiscrete

STATES = Box(-1, 1, (4,), np.float32)


def images(*shape):
    return Box(0, 255, shape, np.uint8)


class Scripted(gymnasium.Env):
    """Step k is rewarded with the sum of its action; images are full of 10 k.

    Args:
      observations: the space of observations.
      actions: the space of actions.
      end: the step that terminates an episode, if any.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, observations=STATES, actions=None, end=None, render_mode=None):
        self.observation_space = observations
        self.action_space = Discrete(2) if actions is None else actions
        self.end, self.render_mode = end, render_mode
        self.steps = 0

    def _observation(self):
        space = self.observation_space
        return np.full(space.shape, 10 * self.steps % 256, space.dtype)

    def reset(self, *, seed=None, options=None):
        assert 0 <= seed < 2**31
        self.steps = 0
        return self._observation(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.steps += 1
        reward = np.sum(action, dtype=np.float64)
        return self._observation(), reward, self.steps == self.end, False, {}

    def render(self):
        assert self.render_mode == "rgb_array"
        return np.full((30, 20, 3), 10 * self.steps % 256, np.uint8)


class Blind(Scripted):
    metadata = {"render_modes": ["human"]}


class Undrawable(Scripted):
    def render(self):
        raise gymnasium.error.DependencyNotInstalled('run `pip install "brushes"`')


def register(name, environment=Scripted, limit=None, **settings):
    gymnasium.register(f"Scripted/{name}-v0", environment, kwargs=settings, max_episode_steps=limit)


register("Choices", observations=images(8, 8, 3), actions=Discrete(3, start=5), end=3)
register("Cut", observations=images(6, 9), limit=3)
register("Drawn", actions=Box(np.float32([-2, 0]), np.float32([2, 10])))
register("Matrix", actions=Box(-1, 1, (2, 3), np.float64))
register("Blind", Blind)
register("Undrawable", Undrawable)
register("Unbounded", actions=Box(-np.inf, 1, (2,)))
register("Several", actions=MultiDiscrete([2, 3]))
