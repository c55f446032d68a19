"""Many simulators in a few processes, stepped as one batch.

P population member, K tasks, A action, n slots of one request. Processes are started as plain
subprocesses, not through `multiprocessing`: that would import the user's main script again in
each of them (JAX with it), asks for an `if __name__ == "__main__"` guard, and forks or not as the
platform likes, while a fork after JAX has started its threads can deadlock. POSIX only.
"""

from __future__ import annotations

import itertools
import mmap
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import warnings
import weakref
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import IO

import numpy as np

from envs.base import SIMULATOR_TIMEOUT, SimulatorError, TaskSpec, TimeStep
from envs.worker import ACTIVE_WAIT, StartFailure, WorkerSettings, record_type

# Seconds after which that is warned of (and again after twice as many), those that are left to a
# simulator once whoever waits has asked not to wait. A process takes longer for its start, on a
# busy machine above all: after how many seconds that is warned of, and how many it has at least.
_PATIENCE, _HURRY, _SLOW_START, _START = 10.0, 5.0, 60.0, 120.0

_BOOTSTRAP = (
    "import sys; sys.path[:] = sys.argv[4:]; "
    "from envs.worker import main; main(*map(int, sys.argv[1:4]))"
)


@dataclass(frozen=True)
class _Worker:
    process: subprocess.Popen
    connection: Connection
    output: IO[bytes]
    tasks: dict[int, TaskSpec]

    def describe(self) -> str:
        hosted: dict[str, list[int]] = {}
        for slot, task in self.tasks.items():
            hosted.setdefault(task.name, []).append(slot)
        return ", ".join(f"{name} (slots {slots})" for name, slots in hosted.items())

    def stuck(self, slot: int, seconds: float, why: str) -> SimulatorError:
        """Ends the process, whose simulator in that slot does not answer; returns the error."""
        self.process.kill()
        self.process.wait()
        return SimulatorError(
            f"The simulator of slot {slot}, {self.tasks[slot].name}, has not answered for "
            f"{seconds:.0f} seconds{why}: its process {self.process.pid} was ended"
        )

    def death(self) -> SimulatorError:
        """The error that says how the process ended, to be called once it has."""
        code = self.process.wait()
        cause = f"signal {-code} ({signal.strsignal(-code)})" if code < 0 else f"exit code {code}"
        self.output.seek(0)
        said = self.output.read()[-4000:].decode(errors="replace").strip()
        return SimulatorError(
            f"The simulator process {self.process.pid} of {self.describe()} ended with {cause}. "
            f"Its last output:\n{said or '(none)'}"
        )


def available_cores() -> int:
    """The number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def hosted_slots(tasks: Sequence[TaskSpec], workers: int, share: int) -> list[list[int]]:
    """Which slots each worker process hosts, so that none is without any.

    Args:
      tasks: the task of each slot.
      workers: at most how many processes there are.
      share: how many slots each thread asks for, see `SimulatorPool`.
    """
    slots = range(len(tasks))
    count = min(workers, len(tasks))
    groups = _groups(len(tasks), workers, share)
    hosted = []
    for group in range(groups):
        # Slots of one task go to different workers, for tasks differ in cost.
        chosen = [slot for slot in slots if slot // share % groups == group]
        by_task = sorted(chosen, key=lambda slot: tasks[slot].name)
        own = min(len(range(group, count, groups)), len(chosen))
        hosted += [sorted(by_task[first::own]) for first in range(own)]
    return hosted


def _groups(slots: int, workers: int, share: int) -> int:
    """How many groups of workers serve the threads that ask for `share` slots each."""
    return min(-(-slots // share), workers, slots)


class SimulatorPool:
    """One simulator per slot, in worker processes that each host a share of the slots.

    Args:
      tasks: the task of each slot.
      image_size: height and width of the images in pixels.
      action_size: A, the length of every action; slots read the first |A| of their task.
      action_repeat: environment steps for which an action is held.
      workers: number of processes; by default one for each core, and never more than slots.
      timeout: seconds after which a simulator that does not answer is taken for stuck, and its
        process ended.
      share: where several threads ask at once, how many slots each asks for: the first so many,
        the next, and so on. Each has processes of its own, if there are enough; else they take
        turns. By default one thread asks for all.

    Raises:
      ModuleNotFoundError: if the simulators' package is not installed.
      SimulatorError: if a process cannot be started, or a simulator fails in its first episode.
    """

    def __init__(
        self,
        tasks: Sequence[TaskSpec],
        image_size: int,
        action_size: int,
        action_repeat: int,
        workers: int | None = None,
        timeout: float = SIMULATOR_TIMEOUT,
        share: int | None = None,
    ):
        self._timeout, self._hurried = timeout, False
        self.tasks = tuple(tasks)
        slots = len(self.tasks)
        self._share = share or slots
        hosting = hosted_slots(self.tasks, workers or available_cores(), self._share)
        groups = _groups(slots, workers or available_cores(), self._share)
        self._locks = [threading.Lock() for _ in range(groups)]
        self._worker_of = {slot: index for index, own in enumerate(hosting) for slot in own}
        count = len(hosting)

        # With a core to spare, the pool waits awake, as its workers do; several threads would keep
        # one another from it.
        spare = count < available_cores() and groups == 1
        self._active_wait = ACTIVE_WAIT if spare else 0.0
        layout = record_type(action_size, image_size)
        self._request_numbers = itertools.count(1)
        self._workers: list[_Worker] = []
        self._finalizer = weakref.finalize(self, _stop, self._workers)
        with _shared_file(slots * layout.itemsize) as file:
            memory = mmap.mmap(file.fileno(), slots * layout.itemsize)
            self._records = np.ndarray((slots,), layout, buffer=memory)
            for own in hosting:
                hosted = {slot: self.tasks[slot] for slot in own}
                self._workers.append(_start(hosted, file.fileno()))
                # One that is dead already is noticed when its reply is waited for.
                with suppress(ConnectionError):
                    self._workers[-1].connection.send(
                        WorkerSettings(hosted, slots, action_size, image_size, action_repeat)
                    )
        try:
            starting = max(timeout, _START)
            started: dict[int, list[int]] = {index: [] for index in range(count)}
            if failures := self._replies(0, started, starting, patience=_SLOW_START):
                raise self._start_error(min(failures))
        except BaseException:
            self.close()
            raise

    def reset(self, slots: np.ndarray, keys: np.ndarray) -> TimeStep:
        """Put new simulators, seeded by `keys` (uint32 [n, words]), into `slots` (int [n]).

        Raises:
          SimulatorError: if a simulator fails or a process dies, with its task and traceback.
        """
        return self._request("reset", slots, keys.tolist())

    def step(self, slots: np.ndarray, actions: np.ndarray) -> TimeStep:
        """One tick of `slots` (int [n], no two alike) with `actions` (float32 [n, A]).

        Raises:
          SimulatorError: if a simulator fails or a process dies, with its task and traceback.
        """
        self._records["action"][slots] = actions
        return self._request("step", slots, [None] * len(slots))

    def _group(self, slot: int) -> int:
        """Which of the groups of workers has a slot."""
        return int(slot) // self._share % len(self._locks)

    def _request(self, command: str, slots: np.ndarray, arguments: list) -> TimeStep:
        if not self._finalizer.alive:
            raise SimulatorError("the environment was closed, make a new one")
        with self._locks[self._group(slots[0])]:
            return self._answer(next(self._request_numbers), command, slots, arguments)

    def _answer(self, number: int, command: str, slots: np.ndarray, arguments: list) -> TimeStep:
        shares: dict[int, tuple[list, list]] = {}
        for slot, argument in zip(slots.tolist(), arguments, strict=True):
            share = shares.setdefault(self._worker_of[slot], ([], []))
            share[0].append(slot)
            share[1].append(argument)
        for index, share in shares.items():
            # A process that is dead is noticed when its reply is waited for.
            with suppress(ConnectionError):
                self._workers[index].connection.send((number, command, *share))
        asked = {index: share[0] for index, share in shares.items()}
        if failures := self._replies(number, asked, self._timeout):
            slot, problem = min(failures)  # of the lowest slot, whoever was first
            raise SimulatorError(
                f"The simulator of slot {slot}, {self.tasks[slot].name}, failed {problem}"
            )
        return TimeStep(*(self._records[name][slots] for name in TimeStep._fields))

    def _start_error(self, failure: StartFailure) -> Exception:
        name = self.tasks[failure.slot].name
        if failure.is_missing:
            error = ModuleNotFoundError(
                failure.problem if name in failure.problem else f"{name}: {failure.problem}"
            )
            error.__cause__ = SimulatorError(failure.trace)
            return error
        said = "\n".join(filter(None, (failure.problem, failure.trace)))
        return SimulatorError(f"The simulator of slot {failure.slot}, {name}, failed: {said}")

    def hurry(self) -> None:
        """Leave simulators no more than a few seconds for each answer from now on: whoever waits
        for them wants to stop. May be called from another thread."""
        self._hurried = True

    def _replies(
        self,
        request: int,
        asked: Mapping[int, list[int]],
        timeout: float,
        patience: float | None = None,
    ) -> list:
        """Wait for replies; returns the failures that they report.

        All replies are read before an error is raised. Those to an earlier request, whose wait
        was interrupted, are passed over.

        Args:
          request: its number.
          asked: of each worker asked, the slots, in the order in which it does them.
          timeout: seconds for which to wait.
          patience: seconds after which to warn first, by default a few.
        """
        pending = {self._workers[index].connection: index for index in asked}
        failures, error = [], None
        began, warned = time.monotonic(), _PATIENCE if patience is None else patience
        deadline = time.perf_counter() + self._active_wait
        while not wait(list(pending), timeout=0) and time.perf_counter() < deadline:
            os.sched_yield()
        while pending:
            # Woken now and then, since a fork of a dead worker may keep its connection open.
            ready = wait(list(pending), timeout=1.0)
            for connection in [x for x in pending if x in ready] or list(pending):
                worker = self._workers[pending[connection]]
                try:
                    if connection.poll():
                        number, failure = connection.recv()
                        if number == request:
                            del pending[connection]
                            if failure is not None:
                                failures.append(failure)
                    elif worker.process.poll() is not None:
                        raise EOFError
                except (EOFError, ConnectionError):
                    del pending[connection]
                    error = worker.death()
            seconds = time.monotonic() - began
            if self._hurried and seconds > _HURRY:
                limit, why = _HURRY, " and the run is to stop"
            else:
                limit, why = timeout, ""
            if seconds > limit:
                for index in pending.values():
                    worker = self._workers[index]
                    slot = self._busy_slot(index, asked[index], request)
                    error = worker.stuck(slot, seconds, why)
                pending = {}
            elif pending and seconds > warned:
                index = next(iter(pending.values()))
                slot = self._busy_slot(index, asked[index], request)
                warnings.warn(
                    f"the simulator of slot {slot}, {self.tasks[slot].name}, has not answered for "
                    f"{warned:.0f} seconds (process {self._workers[index].process.pid}); it is "
                    f"given up after {timeout:.0f}",
                    stacklevel=2,
                )
                warned *= 2
        if error is not None:
            raise error
        return failures

    def _busy_slot(self, index: int, slots: list[int], request: int) -> int:
        """Which of the slots a worker was asked for it has not done yet."""
        left = [s for s in slots if self._records["answered"][s] != request]
        return (left or slots or list(self._workers[index].tasks))[0]

    def close(self) -> None:
        """End the processes. Also done when the pool is collected or the program ends."""
        self._finalizer()


def _shared_file(size: int) -> IO[bytes]:
    # Without a name there is nothing to tidy up, whichever process dies first.
    if hasattr(os, "memfd_create"):
        file = os.fdopen(os.memfd_create("simulators"), "r+b")
    else:
        file = tempfile.TemporaryFile()
    file.truncate(size)
    return file


def _start(tasks: dict[int, TaskSpec], memory_descriptor: int) -> _Worker:
    ours, theirs = socket.socketpair()
    # What the simulators print is noise as long as they live, and a clue when they die.
    output = tempfile.TemporaryFile()
    # The system ends a process with the thread that started it, so that thread has to last.
    lasting = threading.current_thread() is threading.main_thread()
    numbers = (theirs.fileno(), memory_descriptor, os.getpid() if lasting else 0)
    arguments = [*map(str, numbers), *map(os.path.abspath, sys.path)]
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-c", _BOOTSTRAP, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            pass_fds=(theirs.fileno(), memory_descriptor),
            env={"SDL_VIDEODRIVER": "dummy"}  # pictures are drawn where there is no display too
            | os.environ
            # Simulators are not sped up by threads, and there is one process for each core.
            | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            # A group of its own, so that the terminal's Ctrl-C does not reach it while it starts.
            process_group=0,
        )
    return _Worker(process, Connection(ours.detach()), output, tasks)


def _stop(workers: list[_Worker]) -> None:
    for worker in workers:
        worker.connection.close()
    deadline = time.monotonic() + 5
    for worker in workers:
        try:
            worker.process.wait(timeout=max(0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            worker.process.kill()
            worker.process.wait()
        worker.output.close()
