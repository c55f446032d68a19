"""Host simulators as an `Env`: the only file that knows callbacks.

P population member, K tasks, A action. A jitted program reaches a simulator through an ordered
host callback. JAX refuses to vmap those, so each is wrapped in `custom_vmap`, whose rule hands the
whole batch to the same callback once more: however many axes are mapped, one tick is one call.
Each array that goes to the host or comes back costs as much as the call itself, so all but the
images travel as one row of 32-bit words for each simulator.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback

from envs.base import SIMULATOR_TIMEOUT, SimulatorError, TaskSpec, TimeStep
from envs.pool import SimulatorPool
from envs.rows import action_words, check_slots, key_words, mapped_rows, members_of_shard


class Token(NamedTuple):
    """What a jitted program holds in place of a simulator's state.

    Attributes:
      slot: int32 [], which simulator. It must be mapped if anything is.
      tick: int32 [], how many ticks this slot has made since the environment was built; the
        host keeps the same count, and a token that was used before is told by it.
    """

    slot: jax.Array
    tick: jax.Array


class HostCalls:
    """Ordered callbacks that keep the first error they meet: raised where JAX calls them, it
    would lose its type, and its traceback in a jitted program."""

    def __init__(self):
        self._error: BaseException | None = None

    def mapped(self, host: Callable[[np.ndarray], Any], results: Any) -> Callable:
        """A function on the host as one of a single row, in one call however it is mapped.

        Args:
          host: int32 [n, W] -> leaves [n, ...]; never called after an error until `check`.
          results: tree of `jax.ShapeDtypeStruct`, the results for one row.

        Returns:
          The function of int32 [W]. Map over the row if anything is mapped.
        """
        return on_host(self.guarded(host, results), results)

    def guarded(self, host: Callable[[np.ndarray], Any], results: Any) -> Callable:
        """The same function on the host still: it keeps an error, and answers with zeros then."""

        def answer(rows):
            rows = np.asarray(rows)
            if self._error is None:
                try:
                    return host(rows)
                except BaseException as error:  # KeyboardInterrupt too: `check` raises it
                    self._error = error
            return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), _shapes(results, len(rows)))

        return answer

    def check(self) -> None:
        """Wait for callbacks under way and raise the error that one of them met, if any."""
        jax.effects_barrier()
        error, self._error = self._error, None
        if error is not None:
            raise error


def _shapes(results: Any, count: int) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((count, *x.shape), x.dtype), results)


def on_host(answer: Callable[[np.ndarray], Any], results: Any) -> Callable:
    """A function on the host that raises nothing as one of a single row, see
    `HostCalls.mapped`."""

    def call(rows):
        found = io_callback(answer, _shapes(results, len(rows)), rows, ordered=True)
        # Without the barrier XLA writes results that a scan keeps by a fusion that takes the
        # callback's token along, and ends the process over it (NVIDIA cards, jaxlib 0.11.2).
        return jax.lax.optimization_barrier(found)

    return mapped_rows(call)


def _time_step(slot, image, row) -> tuple[Token, TimeStep]:
    reward = jax.lax.bitcast_convert_type(row[1], jnp.float32)
    return Token(slot, row[0]), TimeStep(image, reward, row[2] != 0, row[3] != 0)


def _host_results(ticks: np.ndarray, time_step: TimeStep) -> tuple[np.ndarray, np.ndarray]:
    """Images, and the words of tick, reward, first and terminal: int32 [n, 4]."""
    row = np.empty((len(ticks), 4), np.int32)
    row[:, 0] = ticks
    row[:, 1] = time_step.reward.astype(np.float32).view(np.int32)
    row[:, 2] = time_step.first
    row[:, 3] = time_step.terminal
    return time_step.image, row


def _results(image_size: int) -> tuple[jax.ShapeDtypeStruct, jax.ShapeDtypeStruct]:
    """What the host answers for one slot: the image, and the words of `_host_results`."""
    image = jax.ShapeDtypeStruct((image_size, image_size, 3), jnp.uint8)
    return image, jax.ShapeDtypeStruct((4,), jnp.int32)


class HostProgram:
    """What a program holds of host simulators: calls of the functions that answer for them.

    Args:
      image_size, action_size: see `HostEnv`.
      reset, step: on the host, of rows of words; they raise nothing.
    """

    has_host = True

    def __init__(self, image_size: int, action_size: int, reset: Callable, step: Callable):
        self.image_size, self.action_size = image_size, action_size
        results = _results(image_size)
        self._call_reset, self._call_step = on_host(reset, results), on_host(step, results)

    def reset(self, slot: jax.Array, key: jax.Array) -> tuple[Token, TimeStep]:
        """Put a new simulator, seeded by `key` (typed or raw), into `slot` (int32 []).

        Map over `slot`, whatever else is mapped: with nothing mapped all members would share
        one simulator.
        """
        row = key_words(slot, key)
        return _time_step(row[0], *self._call_reset(row))

    def step(self, state: Token, action: jax.Array) -> tuple[Token, TimeStep]:
        """One tick with `action` (float32 [A], clipped to [-1, 1], or one-hot)."""
        row = action_words(state, action, self.action_size)
        return _time_step(state.slot, *self._call_step(row))


class HostSlots(HostProgram):
    """Host simulators as compiled programs hold them: it is the environment that has them lent at
    the time that answers. So those that are made one after the other share their programs, which
    no cache on the disk can hold.

    Args:
      image_size, action_size: of the environments.
    """

    _free: dict[tuple[int, int], list[HostSlots]] = {}
    _lock = threading.Lock()

    def __init__(self, image_size: int, action_size: int):
        self._env: Callable[[], HostEnv | None] = lambda: None
        super().__init__(
            image_size,
            action_size,
            lambda rows: self._holder().answer_reset(rows),
            lambda rows: self._holder().answer_step(rows),
        )

    @classmethod
    def lent_to(cls, env: HostEnv) -> HostSlots:
        """Some that no other environment has, until they are given back."""
        sizes = env.image_size, env.action_size
        with cls._lock:
            free = cls._free.setdefault(sizes, [])
            slots = free.pop() if free else cls(*sizes)
        slots._env = weakref.ref(env)
        return slots

    def give_back(self) -> None:
        self._env = lambda: None
        with self._lock:
            self._free[self.image_size, self.action_size].append(self)

    def _holder(self) -> HostEnv:
        env = self._env()
        if env is None:
            raise SimulatorError("the environment of this program is closed")
        return env


class HostEnv(HostProgram):
    """An `Env` over simulators that live in worker processes.

    Args:
      tasks: K tasks, all continuous or all discrete; slot s plays tasks[s % K].
      members: P; there are P * K slots.
      image_size: height and width of the images in pixels.
      action_repeat: environment steps for which an action is held.
      action_size: A, at least the largest |A| of the tasks.
      workers: number of worker processes, by default min(cores, slots).
      timeout: seconds after which a simulator that does not answer is given up.
      shards: how many programs play it at once, each P / shards members, rounded up: the
        first so many, the next, and so on. Slots beyond P * K rest always.
    """

    def __init__(
        self,
        tasks: Sequence[TaskSpec],
        members: int,
        image_size: int,
        action_repeat: int,
        action_size: int,
        workers: int | None = None,
        timeout: float = SIMULATOR_TIMEOUT,
        shards: int = 1,
    ):
        self.tasks = tuple(tasks)
        self.members, self.shards = members, shards
        self.action_repeat = action_repeat
        self.discrete = self.tasks[0].discrete
        self._calls = HostCalls()
        share = members_of_shard(members, shards) * len(self.tasks)
        self._ticks = np.full(share * shards, -1, np.int32)
        self._resting = np.arange(share * shards) >= members * len(self.tasks)
        self._pool = SimulatorPool(
            self.tasks * members, image_size, action_size, action_repeat, workers, timeout, share
        )
        results = _results(image_size)
        self.answer_reset = self._calls.guarded(self._host_reset, results)
        self.answer_step = self._calls.guarded(self._host_step, results)
        super().__init__(image_size, action_size, self.answer_reset, self.answer_step)
        self._lent: HostSlots | None = None
        self._closed = False

    @property
    def program(self) -> HostSlots | HostEnv:
        """What programs that outlive this environment are to hold in its place."""
        if self._lent is None:
            if self._closed:
                return self
            self._lent = HostSlots.lent_to(self)
        return self._lent

    def rest(self, slots: np.ndarray) -> None:
        """Let slots idle: their images are black and their rewards 0, and no simulator runs.

        Args:
          slots: bool [P * K]; those that are False are simulated from their next reset on.
        """
        slots, count = np.asarray(slots, bool), self.members * len(self.tasks)
        if slots.shape != (count,):
            raise ValueError(
                f"got a mask of {slots.shape} slots, expected {(count,)} "
                f"({self.members} members x {len(self.tasks)} tasks)"
            )
        jax.effects_barrier()
        self._resting = np.concatenate([slots, np.ones(len(self._resting) - count, bool)])

    def check(self) -> None:
        """Wait for callbacks under way and raise the error that one of them met, if any.

        From the error to this call all ticks are zeros. Afterwards the slots can be reset,
        unless a worker process has died: then make a new environment.
        """
        self._calls.check()

    def hurry(self) -> None:
        """Wait no longer than a few seconds for simulators from now on: the run is to stop."""
        self._pool.hurry()

    def close(self) -> None:
        """End the worker processes."""
        self.hurry()
        jax.effects_barrier()
        self._pool.close()
        lent, self._lent, self._closed = self._lent, None, True
        if lent is not None:
            lent.give_back()

    def _host_reset(self, words: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slots, keys = words[:, 0], words[:, 1:].view(np.uint32)
        self._check_slots(slots)
        self._ticks[slots] += 1  # even if the next line fails: earlier tokens are then stale
        time_step = self._simulated(self._pool.reset, slots, keys)
        first = np.ones(len(slots), bool)
        return _host_results(self._ticks[slots], time_step._replace(first=first))

    def _host_step(self, words: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slots, ticks, actions = words[:, 0], words[:, 1], words[:, 2:].view(np.float32)
        self._check_slots(slots)
        now = self._ticks[slots]
        if (never := now < 0).any():
            raise SimulatorError(f"{self._name(slots[never][0])} was stepped before any reset")
        if (stale := ticks != now).any():
            raise SimulatorError(
                f"{self._name(slots[stale][0])} got the state of tick {ticks[stale][0]}, but its "
                f"simulator is at tick {now[stale][0]}: a state can be stepped once, and each "
                "step must use the one before's"
            )
        if (bad := ~(np.isfinite(actions).all(axis=1) | self._resting[slots])).any():
            raise SimulatorError(
                f"{self._name(slots[bad][0])} got an action that is not finite: {actions[bad][0]}"
            )
        self._ticks[slots] += 1  # even if the next line fails: earlier tokens are then stale
        return _host_results(self._ticks[slots], self._simulated(self._pool.step, slots, actions))

    def _simulated(
        self, call: Callable[..., TimeStep], slots: np.ndarray, argument: np.ndarray
    ) -> TimeStep:
        """What the pool answers for the slots that do not rest; blank ticks for those that do."""
        awake = ~self._resting[slots]
        if awake.all():
            return call(slots, argument)
        count, size = len(slots), self.image_size
        ticks = TimeStep(
            image=np.zeros((count, size, size, 3), np.uint8),
            reward=np.zeros(count, np.float32),
            first=np.zeros(count, bool),
            terminal=np.zeros(count, bool),
        )
        if awake.any():
            for values, played in zip(ticks, call(slots[awake], argument[awake]), strict=True):
                values[awake] = played
        return ticks

    def _name(self, slot: int) -> str:
        return f"slot {slot} ({self.tasks[slot % len(self.tasks)].name})"

    def _check_slots(self, slots: np.ndarray) -> None:
        try:
            members = self.shards * members_of_shard(self.members, self.shards)
            check_slots(slots, members, len(self.tasks))
        except ValueError as error:
            raise SimulatorError(str(error)) from None
