"""A process that hosts simulators; the other end of `envs.pool`. Imports no JAX.

Pool and worker talk over a socket, one pickled message each way per request, and pass actions
and images through shared memory: an array with one record (see `record_type`) per slot.
"""

from __future__ import annotations

import ctypes
import faulthandler
import mmap
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from typing import NamedTuple

import numpy as np

from envs.base import Simulator, SimulatorError, TaskSpec, TimeStep
from envs.wrappers import ActionPadding, ActionRepeat, make_simulator

# Seconds for which either end asks again for the other's message before it falls asleep.
ACTIVE_WAIT = 0.003

_PR_SET_PDEATHSIG = 1  # from linux/prctl.h


@dataclass(frozen=True)
class WorkerSettings:
    """What a worker is told at its start: the task of each slot it hosts, and the sizes."""

    tasks: dict[int, TaskSpec]
    slots: int
    action_size: int
    image_size: int
    action_repeat: int


class StartFailure(NamedTuple):
    """Why a worker cannot serve: text only, as not every exception can be pickled.

    Attributes:
      slot: whose simulator failed.
      problem: what is wrong with it.
      trace: the traceback, if there is one.
      is_missing: whether a package is not installed.
    """

    slot: int
    problem: str
    trace: str = ""
    is_missing: bool = False


def record_type(action_size: int, image_size: int) -> np.dtype:
    """One slot's place in shared memory: the action going in, the time step coming out."""
    return np.dtype(
        [
            ("action", np.float32, (action_size,)),
            ("image", np.uint8, (image_size, image_size, 3)),
            ("reward", np.float32),
            ("first", np.bool_),
            ("terminal", np.bool_),
            ("answered", np.int64),  # the number of the last request that this slot has done
        ],
        align=True,
    )


class Phase:
    """Episodes one after another in one simulator, from one `reset` to the next.

    A phase begins with a simulator made anew, so that nothing before it matters. Within it, an
    episode follows the last in the same simulator, which is a hundred times faster; the history
    it inherits is a function of the phase's key and actions, and so is the whole phase.
    """

    def __init__(self, make_simulator: Callable[[], Simulator]):
        self._make_simulator = make_simulator
        self._simulator: Simulator | None = None
        self._key: Sequence[int] = ()
        self._episode = 0
        self._ticks = 0
        self._ended = False

    def place(self) -> str:
        """Where in the phase this is, in words."""
        return f"tick {self._ticks} of episode {self._episode} of the phase"

    def reset(self, key: Sequence[int]) -> TimeStep:
        """Start a phase whose episodes are seeded by `key`, any number of 32-bit words."""
        self.close()
        self._simulator = simulator = self._make_simulator()
        self._key = key
        self._episode = 0
        return self._start_episode(simulator)

    def _start_episode(self, simulator: Simulator) -> TimeStep:
        words = np.random.SeedSequence([*self._key, self._episode]).generate_state(4)
        self._episode += 1
        self._ticks = 0
        simulator.reset(int.from_bytes(words.tobytes(), "little"))
        self._ended = False
        return TimeStep(simulator.render(), 0.0, True, False)

    def step(self, action: np.ndarray) -> TimeStep:
        """One tick: hold `action`, or start the next episode if the last one has ended."""
        simulator = self._simulator
        assert simulator is not None, "a phase begins with a reset"
        if self._ended:
            return self._start_episode(simulator)
        self._ticks += 1
        outcome = simulator.step(action)
        self._ended = outcome.terminal or outcome.truncated
        return TimeStep(simulator.render(), outcome.reward, False, outcome.terminal)

    def close(self) -> None:
        if self._simulator is not None:
            self._simulator.close()
            self._simulator = None


def _problem(time_step: TimeStep, shape: tuple[int, ...]) -> str | None:
    """What is wrong with what a simulator gave: it must not reach the replay."""
    image = time_step.image
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.shape != shape:
        what = (
            f"{image.dtype} {list(image.shape)}" if isinstance(image, np.ndarray) else repr(image)
        )
        return f"its picture is {what[:200]}, expected uint8 {list(shape)}"
    if not np.isscalar(time_step.reward) and np.shape(time_step.reward) != ():
        return f"its reward is {time_step.reward!r}, expected one number"
    if not np.isfinite(time_step.reward):
        return f"its reward is {time_step.reward}, expected a finite number"
    if abs(time_step.reward) > np.finfo(np.float32).max:
        return f"its reward is {time_step.reward}, too large for 32 bits"
    return None


def _serve(connection: Connection, phases: dict[int, Phase], records: np.ndarray) -> None:
    """Answer requests until the pool closes the connection or its process is gone."""
    parent = os.getppid()
    actions = records["action"]
    results = TimeStep(*(records[name] for name in TimeStep._fields))
    while True:
        # Asleep, a core takes longer to wake up than many simulators take for a tick. So ask again
        # for as long as a policy thinks, leaving the core to whoever wants it.
        deadline = time.perf_counter() + ACTIVE_WAIT
        while not connection.poll(0) and time.perf_counter() < deadline:
            os.sched_yield()
        # The end of the connection is not enough: a fork of the parent may keep it open.
        while not connection.poll(2.0):
            if os.getppid() != parent:
                return
        number, command, slots, arguments = connection.recv()
        failure = None
        for slot, argument in zip(slots, arguments, strict=True):
            try:
                if command == "reset":
                    time_step = phases[slot].reset(argument)
                else:
                    time_step = phases[slot].step(actions[slot])
                if problem := _problem(time_step, records["image"].shape[1:]):
                    failure = (slot, f"at {phases[slot].place()}, {problem}")
                    break
                for result, value in zip(results, time_step, strict=True):
                    result[slot] = value
                records["answered"][slot] = number
            except Exception:
                failure = (slot, f"at {phases[slot].place()}:\n{traceback.format_exc()}")
                break
        connection.send((number, failure))


def _make_simulator(task: TaskSpec, settings: WorkerSettings) -> Simulator:
    simulator = make_simulator(task, settings.image_size)
    return ActionPadding(ActionRepeat(simulator, settings.action_repeat), task.action_size)


def _try(task: TaskSpec, settings: WorkerSettings) -> str | None:
    """Starts an episode and looks at it, so that what is not installed is known at once.

    Returns:
      What is wrong with its picture, if anything.
    """
    simulator = _make_simulator(task, settings)
    try:
        simulator.reset(0)
        shape = (settings.image_size, settings.image_size, 3)
        return _problem(TimeStep(simulator.render(), 0.0, True, False), shape)
    finally:
        simulator.close()


def _first_problem(settings: WorkerSettings) -> StartFailure | None:
    """Tries the tasks, each once."""
    tried = set()
    for slot, task in settings.tasks.items():
        if task in tried:
            continue
        tried.add(task)
        try:
            problem = _try(task, settings)
        except ModuleNotFoundError as error:
            return StartFailure(slot, str(error), traceback.format_exc(), is_missing=True)
        except SimulatorError as error:  # says all there is to say
            return StartFailure(slot, str(error))
        except BaseException as error:  # SystemExit of a simulator too
            problem = f"{type(error).__name__}: {error}"
            return StartFailure(slot, problem, traceback.format_exc())
        if problem:
            return StartFailure(slot, problem)
    return None


def _die_with(parent: int) -> None:
    """Have the system end this process with that one, even while a simulator is stuck."""
    if parent and sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            sys.exit()  # it was gone before


def main(connection_descriptor: int, memory_descriptor: int, parent: int) -> None:
    """Serve the pool at the other end of the socket; returns when it is gone.

    Args:
      connection_descriptor: of the socket.
      memory_descriptor: of the shared memory.
      parent: the process to end with; 0 to end only after the request in work.
    """
    _die_with(parent)
    # Ctrl-C is for the process that trains, which ends its phase with our help.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable()
    connection = Connection(connection_descriptor)
    settings: WorkerSettings = connection.recv()
    if failure := _first_problem(settings):
        connection.send((0, failure))
        return
    layout = record_type(settings.action_size, settings.image_size)
    memory = mmap.mmap(memory_descriptor, settings.slots * layout.itemsize)
    records = np.ndarray((settings.slots,), layout, buffer=memory)
    phases = {
        slot: Phase(partial(_make_simulator, task, settings))
        for slot, task in settings.tasks.items()
    }
    connection.send((0, None))
    with suppress(EOFError, ConnectionError):
        _serve(connection, phases, records)
