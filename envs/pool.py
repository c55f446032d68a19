"""Many simulators in a few processes, stepped as one batch.

P population member, K tasks, A action, n slots of one request. Processes are started as plain
subprocesses, not through `multiprocessing`: that would import the user's main script again in
each of them (JAX with it), asks for an `if __name__ == "__main__"` guard, and forks or not as the
platform likes, while a fork after JAX has started its threads can deadlock. POSIX only.
"""

from __future__ import annotations

import mmap
import os
import pickle
import signal
import socket
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import IO

import numpy as np

from envs.base import SimulatorError, TaskSpec, TimeStep
from envs.worker import WorkerSettings, record_type

_BOOTSTRAP = (
    "import sys; sys.path[:] = sys.argv[3:]; "
    "from envs.worker import main; main(int(sys.argv[1]), int(sys.argv[2]))"
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

    def death(self) -> SimulatorError:
        """The error that says how the process ended, to be called once it has."""
        code = self.process.wait()
        cause = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
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


class SimulatorPool:
    """One simulator per slot, in worker processes that each host a share of the slots.

    Args:
        tasks: the task of each slot.
        image_size: height and width of the images in pixels.
        action_size: A, the length of every action; slots read the first |A| of their task.
        action_repeat: environment steps for which an action is held.
        workers: number of processes; by default one for each core, and never more than slots.

    Raises:
        ModuleNotFoundError: if the simulators' package is not installed.
        SimulatorError: if a process cannot be started.
    """

    def __init__(
        self,
        tasks: Sequence[TaskSpec],
        image_size: int,
        action_size: int,
        action_repeat: int,
        workers: int | None = None,
    ):
        self.tasks = tuple(tasks)
        count = min(workers or available_cores(), len(self.tasks))
        layout = record_type(action_size, image_size)
        # An unlinked file that both sides map; named shared memory would have to be tidied up.
        memory_file = tempfile.TemporaryFile(dir="/dev/shm" if os.path.isdir("/dev/shm") else None)
        memory_file.truncate(len(self.tasks) * layout.itemsize)
        memory = mmap.mmap(memory_file.fileno(), 0)
        self._records = np.ndarray((len(self.tasks),), layout, buffer=memory)

        # Slots of one task go to different workers, for tasks differ in cost.
        by_task = sorted(range(len(self.tasks)), key=lambda slot: self.tasks[slot].name)
        self._worker_of = np.empty(len(self.tasks), np.int64)
        self._worker_of[by_task] = np.arange(len(self.tasks)) % count
        self._workers: list[_Worker] = []
        self._finalizer = weakref.finalize(self, _stop, self._workers)
        with memory_file:
            for index in range(count):
                hosted = {int(s): self.tasks[s] for s in np.flatnonzero(self._worker_of == index)}
                worker = _start(hosted, memory_file.fileno())
                self._workers.append(worker)
                worker.connection.send(
                    WorkerSettings(hosted, len(self.tasks), action_size, image_size, action_repeat)
                )
        for reply in self._replies(range(count)).values():
            if reply is not None:
                self.close()
                error, trace = reply
                raise pickle.loads(error) from SimulatorError(trace)

    def reset(self, slots: np.ndarray, keys: np.ndarray) -> TimeStep:
        """Put new simulators, seeded by `keys` (uint32 [n, words]), into `slots` (int [n])."""
        return self._request("reset", slots, keys.tolist())

    def step(self, slots: np.ndarray, actions: np.ndarray) -> TimeStep:
        """One tick of `slots` (int [n], no two alike) with `actions` (float32 [n, A])."""
        self._records["action"][slots] = actions
        return self._request("step", slots)

    def _request(self, command: str, slots: np.ndarray, arguments: list | None = None) -> TimeStep:
        shares = {}
        for index in np.unique(self._worker_of[slots]):
            positions = np.flatnonzero(self._worker_of[slots] == index)
            message = [command, slots[positions].tolist()]
            if arguments is not None:
                message.append([arguments[i] for i in positions])
            shares[int(index)] = message
        for index, message in shares.items():
            try:
                self._workers[index].connection.send(message)
            except ConnectionError:
                raise self._workers[index].death() from None
        # All replies are read before an error is raised, or the next request would get them.
        for reply in self._replies(shares).values():
            if reply is not None:
                slot, trace = reply
                raise SimulatorError(
                    f"The simulator of slot {slot}, {self.tasks[slot].name}, failed:\n{trace}"
                )
        records = self._records[slots]
        return TimeStep(*(records[name].copy() for name in TimeStep._fields))

    def _replies(self, workers: Sequence[int]) -> dict[int, object]:
        """One reply of each of `workers`; raises if one of them has died."""
        pending = {self._workers[index].connection: index for index in workers}
        replies, dead = {}, None
        while pending:
            for connection in wait(list(pending), timeout=2.0) or list(pending):
                index = pending[connection]
                try:
                    if connection.poll():
                        replies[index] = connection.recv()
                        del pending[connection]
                    elif self._workers[index].process.poll() is not None:
                        raise EOFError
                except (EOFError, ConnectionError):
                    dead = dead or self._workers[index]
                    del pending[connection]
        if dead is not None:
            raise dead.death()
        return replies

    def close(self) -> None:
        """End the processes. Also done when the pool is collected or the program ends."""
        self._finalizer()


def _start(tasks: dict[int, TaskSpec], memory_descriptor: int) -> _Worker:
    ours, theirs = socket.socketpair()
    # What the simulators print is noise as long as they live, and a clue when they die.
    output = tempfile.TemporaryFile()
    arguments = [str(theirs.fileno()), str(memory_descriptor), *map(os.path.abspath, sys.path)]
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-c", _BOOTSTRAP, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            pass_fds=(theirs.fileno(), memory_descriptor),
            # Simulators are not sped up by threads, and there is one process for each core.
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            # A group of its own, so that the terminal's Ctrl-C does not reach it while it starts.
            process_group=0,
        )
    return _Worker(process, Connection(ours.detach()), output, tasks)


def _stop(workers: list[_Worker]) -> None:
    for worker in workers:
        worker.connection.close()
    for worker in workers:
        try:
            worker.process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            worker.process.kill()
            worker.process.wait()
        worker.output.close()
