"""What an environment is: the types that every backend and every user of `envs` share.

Axis letters: P population member, K tasks, A action (the largest |A| of the tasks).

Nothing here imports JAX, so that simulator processes, which import this file, do not either.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

SIMULATOR_TIMEOUT = 300.0
"""Seconds after which a simulator that does not answer is taken for stuck, unless told otherwise.
"""


@dataclass(frozen=True)
class TaskSpec:
    """What is known of a task without making a simulator of it.

    Attributes:
      name: the name in this package, `backend/task`, such as "bullet/hopper".
      title: the name as it is printed, such as "Hopper".
      action_size: |A|, the number of continuous actions, each in [-1, 1], or of choices.
      simulator: where to find its `Simulator`, as "module:callable"; it is called with
        (title, image_size).
      gymnasium_id: the id under which `gymnasium.make` finds the same task.
      action_repeat: environment steps for which one action is held, unless told otherwise.
      time_limit: length of an episode in environment steps (not in actions).
      step_seconds: simulated time of one environment step, in seconds.
      discrete: whether an action is one of |A| choices, given as a one-hot vector.
      physics: the physics engine, of a backend that has several.
      levels: known returns of whole episodes of `time_limit` environment steps, as pairs of what
        was done and the return it brought, measured on this simulator.
      supersample: pictures are drawn this many times as large, and averaged down.
      renderer: what draws the pictures, of a backend that has several renderers.
    """

    name: str
    title: str
    action_size: int
    simulator: str
    gymnasium_id: str
    action_repeat: int = 2
    time_limit: int = 1000
    step_seconds: float = 0.0165
    discrete: bool = False
    physics: str = ""
    levels: tuple[tuple[str, float], ...] = ()
    supersample: int = 1
    renderer: str = ""

    @property
    def has_host(self) -> bool:
        """Whether a simulator or a renderer of it runs on the host."""
        return self.renderer != "jax"


class TimeStep(NamedTuple):
    """What one tick of an environment gives. Every leaf gets the leading axes of a `vmap`.

    Attributes:
      image: uint8 [height, width, 3], after the tick.
      reward: float32 [], summed over the action repeat; 0 on a reset.
      first: bool [], True if this tick was a reset.
      terminal: bool [], True if the episode ended by itself; never by a time limit.
    """

    image: Any
    reward: Any
    first: Any
    terminal: Any


class Env(Protocol):
    """Simulators as a pair of functions that can be traced, scanned and mapped (nested too).

    An environment holds a number of slots, one simulator each. For a population of P members
    and K tasks, slot = member * K + task. After a terminal tick the next `step` ignores its
    action and starts a new episode (`first` is True, the reward 0); so it does where a simulator
    with a time limit of its own cuts an episode, which no tick calls terminal. No other time limit
    applies: the caller runs a phase for as many ticks as it wants, and starts the next one with
    `reset`. Everything from one `reset` to the next is a function of its key and the actions alone.

    Attributes:
      action_size: A, the largest |A| of the tasks; smaller tasks read their first |A| entries.
      image_size: height and width of the images in pixels.
      discrete: True if actions are one-hot vectors of length A; False for continuous ones.
      has_host: False if all of it is part of the jitted program; True if anything, simulators or
        renderers, runs on the host.
      shards: how many programs, one for each device, play it at once, each with members of its own.
    """

    action_size: int
    image_size: int
    discrete: bool
    has_host: bool
    shards: int

    def reset(self, slot: Any, key: Any) -> tuple[Any, TimeStep]:
        """Put a new simulator, seeded by `key`, into `slot` (int32 []).

        Every member must be given its own slot: map over slots even if all share one key.
        """
        ...

    def step(self, state: Any, action: Any) -> tuple[Any, TimeStep]:
        """Hold `action` (float32 [A]) for the action repeat; one tick.

        `state` is used up: only the state that this returns can be stepped next.
        """
        ...

    def check(self) -> None:
        """Raise the error that a simulator met, if any. Call it outside jit after a phase."""
        ...

    def hurry(self) -> None:
        """Wait no longer than a few seconds for any simulator from now on: the caller wants to
        stop. May be called while a program runs."""
        ...

    def close(self) -> None:
        """Free what the environment holds. It cannot be used afterwards."""
        ...


LEAST_SIZE = 8
"""Height and width in pixels of the smallest pictures that are drawn of Brax's tasks."""


def check_whole(what: str, value: Any, least: int) -> None:
    """Raise a ValueError that begins with "got `what`" unless a value is a whole number of at least
    `least`."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise ValueError(f"got {what}{value!r}, expected a whole number of at least {least}")


class SimulatorError(RuntimeError):
    """A simulator failed, or was used in a way that it cannot follow."""


class Outcome(NamedTuple):
    """What one step of a `Simulator` gives: reward, and how the episode ended, if it did."""

    reward: float
    terminal: bool
    truncated: bool = False


class Simulator(Protocol):
    """One task on the host. Steps and pictures are apart, for not every step is looked at."""

    def reset(self, seed: int) -> None:
        """Start an episode. The first reset of a new simulator is the most reproducible one:
        it depends on `seed` alone, later ones also on what was simulated before."""
        ...

    def step(self, action: np.ndarray) -> Outcome:
        """Advance by one environment step with `action` (float [|A|], clipped to [-1, 1]; of a
        discrete task the index of the largest entry is the choice)."""
        ...

    def render(self) -> np.ndarray:
        """The picture of the present state: uint8 [image_size, image_size, 3]."""
        ...

    def close(self) -> None:
        """Free the simulator. It cannot be used afterwards."""
        ...
