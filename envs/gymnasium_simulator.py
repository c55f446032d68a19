"""Any gymnasium environment as a task: its own images, or the pictures that it draws.

A task is named `gymnasium/ID`, where ID is what `gymnasium.make` takes: "CartPole-v1", or
"package.module:ALE/Pong-v5", where the module is one that registers the id. Simulator processes
know no ids that were registered in the process that trains, so environments of one's own are named
with their module.
"""

from __future__ import annotations

import difflib
import functools
import math
import traceback
from typing import NamedTuple

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete, Space
from PIL import Image

from envs.base import Outcome, SimulatorError, TaskSpec


class _Traits(NamedTuple):
    """What one look at an environment tells.

    Attributes:
      task: as a task of this package.
      observes_images: whether its observations are images; otherwise it draws pictures.
    """

    task: TaskSpec
    observes_images: bool


def gymnasium_task(id: str) -> TaskSpec:
    """What is known of the gymnasium environment `id`, which is made once to ask it.

    Raises:
      ValueError: if there is no such id (near ones are named), if it shows no images, or if
        its actions are neither a bounded `Box` nor `Discrete`.
      ModuleNotFoundError: if it needs a package that is not installed.
      SimulatorError: if its own code raises anything else.
    """
    return _traits(id).task


@functools.cache
def _traits(id: str) -> _Traits:
    name = f"gymnasium/{id}"
    env = _make(id)
    try:
        observation, actions = env.observation_space, env.action_space
        modes, frames = env.metadata.get("render_modes") or (), env.metadata.get("render_fps")
        env.close()
    except Exception as error:
        raise _failed(name, error) from error
    observes_images = _is_image(observation)
    if not observes_images and "rgb_array" not in modes:
        raise ValueError(
            f"{name} shows no images: its observations are {observation}, expected a Box of uint8 "
            f"[height, width, 1 or 3]; or else it should render 'rgb_array', not {list(modes)}"
        )
    task = TaskSpec(
        name=name,
        title=id,
        action_size=_action_size(name, actions),
        simulator="envs.gymnasium_simulator:GymnasiumSimulator",
        gymnasium_id=id,
        time_limit=(env.spec and env.spec.max_episode_steps) or TaskSpec.time_limit,
        step_seconds=1 / (frames or 30),
        discrete=isinstance(actions, Discrete),
    )
    return _Traits(task, observes_images)


def _make(id: str, **options) -> gymnasium.Env:
    name = f"gymnasium/{id}"
    try:
        return gymnasium.make(id, disable_env_checker=True, **options)
    except (gymnasium.error.UnregisteredEnv, gymnasium.error.DeprecatedEnv) as error:
        reason = str(error).partition(" Did you mean")[0]
        near = difflib.get_close_matches(id.rpartition(":")[2], gymnasium.registry)
        hint = f" Did you mean {' or '.join(f'gymnasium/{other}' for other in near)}?"
        raise ValueError(f"unknown task {name!r}: {reason}{hint if near else ''}") from None
    except gymnasium.error.DependencyNotInstalled as error:
        raise _not_installed(name, error) from error
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{name} cannot be made: {error}") from error
    except gymnasium.error.Error as error:
        raise ValueError(f"unknown task {name!r}: {error}") from error
    except Exception as error:
        raise _failed(name, error) from error


def _failed(name: str, error: Exception) -> SimulatorError:
    """What an environment's own code met, as text: its type may be known to nobody else."""
    trace = "".join(traceback.format_exception(error))
    return SimulatorError(f"{name} cannot be made: {type(error).__name__}: {error}\n{trace}")


def _not_installed(name: str, error: Exception) -> ModuleNotFoundError:
    return ModuleNotFoundError(f"{name} needs a package that is not installed: {error}")


def _is_image(space: Space) -> bool:
    if not isinstance(space, Box) or space.dtype != np.uint8:
        return False
    return len(space.shape) == 2 or (len(space.shape) == 3 and space.shape[2] in (1, 3))


def _action_size(name: str, actions: Space) -> int:
    if isinstance(actions, Discrete):
        return int(actions.n)
    if not isinstance(actions, Box) or not np.issubdtype(actions.dtype, np.floating):
        raise ValueError(
            f"the actions of {name} are {actions}, expected a Box of floats, or Discrete"
        )
    if not actions.is_bounded():
        raise ValueError(
            f"the actions of {name} are {actions}, expected finite bounds, to which [-1, 1] is "
            "scaled: wrap it in gymnasium.wrappers.RescaleAction or the like"
        )
    return math.prod(actions.shape)


class GymnasiumSimulator:
    """One gymnasium environment, with images of the size asked for.

    Continuous actions in [-1, 1] are scaled to the bounds of the environment's own; of discrete
    ones the largest entry is the choice. Rewards and ends are the environment's.

    Args:
      title: the id for `gymnasium.make`.
      image_size: height and width in pixels to which images are resized, whatever their shape.
    """

    def __init__(self, title: str, image_size: int):
        self._name = f"gymnasium/{title}"
        self._image_size = image_size
        self._observes_images = _traits(title).observes_images
        render_mode = None if self._observes_images else "rgb_array"
        self._env = _make(title, render_mode=render_mode)
        self._observation = None

    def reset(self, seed: int) -> None:
        """Start an episode."""
        # Many environments take seeds of 32 bits only.
        self._observation, _ = self._env.reset(seed=seed % 2**31)

    def step(self, action: np.ndarray) -> Outcome:
        """Advance by one step of the environment."""
        step = self._env.step(self._own(np.asarray(action, np.float64)))
        self._observation, reward, terminated, truncated, _ = step
        return Outcome(float(reward), bool(terminated), bool(truncated))

    def _own(self, action: np.ndarray) -> np.ndarray | int:
        """The environment's own action for a vector of length |A|."""
        space = self._env.action_space
        if isinstance(space, Discrete):
            return int(space.start + np.argmax(action))
        assert isinstance(space, Box)
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        share = (np.clip(action, -1.0, 1.0).reshape(space.shape) + 1) / 2
        return np.clip(low + share * (high - low), low, high).astype(space.dtype)

    def render(self) -> np.ndarray:
        """The present image, uint8 [image_size, image_size, 3]."""
        if self._observes_images:
            return resize(_checked(self._observation, "observation"), self._image_size)
        try:
            return resize(_checked(self._env.render(), "picture"), self._image_size)
        except gymnasium.error.DependencyNotInstalled as error:
            raise _not_installed(self._name, error) from error

    def close(self) -> None:
        """Free the environment."""
        self._env.close()


def _checked(image, what: str) -> np.ndarray:
    """An environment's picture, if it is one: cast in silence, others would turn black."""
    array = np.asarray(image) if isinstance(image, np.ndarray | list | tuple) else None
    if array is not None and array.dtype == np.uint8 and array.size:
        if array.ndim == 2 or (array.ndim == 3 and array.shape[2] in (1, 3)):
            return array
    found = repr(image)[:80] if array is None else f"{array.dtype} {list(array.shape)}"
    raise SimulatorError(
        f"the environment's {what} is {found}, expected uint8 [height, width, 1 or 3]"
    )


def resize(image: np.ndarray, size: int) -> np.ndarray:
    """An image of any size as uint8 [size, size, 3], each pixel the mean of those it covers.

    Args:
      image: uint8 [height, width], [height, width, 1] or [height, width, 3].
      size: height and width of the result.
    """
    image = np.asarray(image, np.uint8)
    image = image.reshape(*image.shape[:2], -1)
    image = np.broadcast_to(image, (*image.shape[:2], 3))
    resized = Image.fromarray(np.ascontiguousarray(image)).resize(
        (size, size), Image.Resampling.BOX
    )
    return np.asarray(resized)
