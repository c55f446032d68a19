"""A process that hosts simulators; the other end of `envs.pool`. Imports no JAX.

Pool and worker talk over a socket, one pickled message each way per request, and pass actions
and images through shared memory: an array with one record (see `record_type`) per slot.
"""

from __future__ import annotations

import faulthandler
import mmap
import os
import pickle
import signal
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection

import numpy as np

from envs.base import Simulator, TaskSpec, TimeStep
from envs.wrappers import ActionPadding, ActionRepeat, make_simulator

# Seconds for which either end asks again for the other's message before it falls asleep.
ACTIVE_WAIT = 0.003


@dataclass(frozen=True)
class WorkerSettings:
    """What a worker is told at its start: the task of each slot it hosts, and the sizes."""

    tasks: dict[int, TaskSpec]
    slots: int
    action_size: int
    image_size: int
    action_repeat: int


def record_type(action_size: int, image_size: int) -> np.dtype:
    """One slot's place in shared memory: the action going in, the time step coming out."""
    return np.dtype(
        [
            ("action", np.float32, (action_size,)),
            ("image", np.uint8, (image_size, image_size, 3)),
            ("reward", np.float32),
            ("first", np.bool_),
            ("terminal", np.bool_),
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
        self._ended = False

    def reset(self, key: Sequence[int]) -> TimeStep:
        """Start a phase whose episodes are seeded by `key`, any number of 32-bit words."""
        self.close()
        self._simulator = self._make_simulator()
        self._key = key
        self._episode = 0
        return self._start_episode()

    def _start_episode(self) -> TimeStep:
        words = np.random.SeedSequence([*self._key, self._episode]).generate_state(4)
        self._simulator.reset(int.from_bytes(words.tobytes(), "little"))
        self._episode += 1
        self._ended = False
        return TimeStep(self._simulator.render(), 0.0, True, False)

    def step(self, action: np.ndarray) -> TimeStep:
        """One tick: hold `action`, or start the next episode if the last one has ended."""
        if self._ended:
            return self._start_episode()
        outcome = self._simulator.step(action)
        self._ended = outcome.terminal or outcome.truncated
        return TimeStep(self._simulator.render(), outcome.reward, False, outcome.terminal)

    def close(self) -> None:
        if self._simulator is not None:
            self._simulator.close()
            self._simulator = None


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
                for result, value in zip(results, time_step, strict=True):
                    result[slot] = value
            except Exception:
                failure = (slot, traceback.format_exc())
                break
        connection.send((number, failure))


def _make_simulator(task: TaskSpec, settings: WorkerSettings) -> Simulator:
    simulator = make_simulator(task, settings.image_size)
    return ActionPadding(ActionRepeat(simulator, settings.action_repeat), task.action_size)


def _try(task: TaskSpec, settings: WorkerSettings) -> None:
    """Starts an episode and looks at it, so that what is not installed is known at once."""
    simulator = _make_simulator(task, settings)
    try:
        simulator.reset(0)
        simulator.render()
    finally:
        simulator.close()


def main(connection_descriptor: int, memory_descriptor: int) -> None:
    """Serve the pool at the other end of the socket; returns when it is gone."""
    # Ctrl-C is for the process that trains, which ends its phase with our help.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable()
    connection = Connection(connection_descriptor)
    settings: WorkerSettings = connection.recv()
    try:
        for task in set(settings.tasks.values()):
            _try(task, settings)
    except Exception as error:
        connection.send((0, (pickle.dumps(error), traceback.format_exc())))
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
