"""Host simulators as an `Env`: the only file that knows callbacks.

P population member, K tasks, A action. A jitted program reaches a simulator through an ordered
host callback. JAX refuses to vmap those, so each is wrapped in `custom_vmap`, whose rule hands the
whole batch to the same callback once more: however many axes are mapped, one tick is one call.
Each array that goes to the host or comes back costs as much as the call itself, so all but the
images travel as one row of 32-bit words for each simulator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.experimental import io_callback

from envs.base import SimulatorError, TaskSpec, TimeStep
from envs.pool import SimulatorPool


class Token(NamedTuple):
    """What a jitted program holds in place of a simulator's state.

    Attributes:
        slot: int32 [], which simulator. It must be mapped if anything is.
        tick: int32 [], how many ticks this slot has made since the environment was built; the
            host keeps the same count, and a token that was used before is told by it.
    """

    slot: jax.Array
    tick: jax.Array


def _mapped_callback(host: Callable, results) -> Callable:
    """An ordered callback that takes any leading axes, in one call of `host`.

    Args:
        host: called with int32 [*lead, W], returns results of shapes lead + those of `results`.
        results: tree of `jax.ShapeDtypeStruct`, the results for one simulator.

    Returns:
        The function of int32 [W]. Map over the words if anything is mapped.
    """

    @custom_vmap
    def call(words):
        lead = words.shape[:-1]
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(lead + x.shape, x.dtype), results)
        return io_callback(host, shapes, words, ordered=True)

    @call.def_vmap
    def _(axis_size, in_batched, words):
        out = call(words)
        return out, jax.tree.map(lambda _: True, out)

    return call


def _words(*values: jax.Array) -> jax.Array:
    """The bits of scalars and vectors of 32-bit types, joined: int32 [W]."""
    return jnp.concatenate(
        [jax.lax.bitcast_convert_type(jnp.atleast_1d(x), jnp.int32) for x in values]
    )


def _time_step(slot, image, words) -> tuple[Token, TimeStep]:
    reward = jax.lax.bitcast_convert_type(words[1], jnp.float32)
    return Token(slot, words[0]), TimeStep(image, reward, words[2] != 0, words[3] != 0)


class HostEnv:
    """An `Env` over simulators that live in worker processes.

    Args:
        tasks: K tasks, all continuous or all discrete; slot s plays tasks[s % K].
        members: P; there are P * K slots.
        image_size: height and width of the images in pixels.
        action_repeat: environment steps for which an action is held.
        action_size: A, at least the largest |A| of the tasks.
        workers: number of worker processes, by default min(cores, slots).
    """

    def __init__(
        self,
        tasks: Sequence[TaskSpec],
        members: int,
        image_size: int,
        action_repeat: int,
        action_size: int,
        workers: int | None = None,
    ):
        self.tasks = tuple(tasks)
        self.members = members
        self.image_size = image_size
        self.action_repeat = action_repeat
        self.action_size = action_size
        self.discrete = self.tasks[0].discrete
        self._error: BaseException | None = None
        self._ticks = np.full(members * len(self.tasks), -1, np.int32)
        self._pool = SimulatorPool(
            self.tasks * members, image_size, action_size, action_repeat, workers
        )
        # The image, and the words of tick, reward, first and terminal.
        self._results = (
            jax.ShapeDtypeStruct((image_size, image_size, 3), jnp.uint8),
            jax.ShapeDtypeStruct((4,), jnp.int32),
        )
        self._call_reset = _mapped_callback(self._guarded(self._host_reset), self._results)
        self._call_step = _mapped_callback(self._guarded(self._host_step), self._results)

    def reset(self, slot: jax.Array, key: jax.Array) -> tuple[Token, TimeStep]:
        """Put a new simulator, seeded by `key` (typed or raw), into `slot` (int32 []).

        Map over `slot`, whatever else is mapped: with nothing mapped all members would share
        one simulator.
        """
        if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
            key = jax.random.key_data(key)
        slot = jnp.asarray(slot, jnp.int32)
        if slot.shape != () or key.ndim != 1:
            raise ValueError(
                f"got slots of shape {slot.shape} and keys of shape {key.shape[:-1]}, expected "
                "one slot and one key: map over several with jax.vmap"
            )
        return _time_step(slot, *self._call_reset(_words(slot, key)))

    def step(self, state: Token, action: jax.Array) -> tuple[Token, TimeStep]:
        """One tick with `action` (float32 [A], clipped to [-1, 1], or one-hot)."""
        if action.shape != (self.action_size,):
            raise ValueError(
                f"got an action of shape {action.shape}, expected {(self.action_size,)}: "
                "map over several simulators with jax.vmap"
            )
        words = _words(*state, jnp.asarray(action, jnp.float32))
        return _time_step(state.slot, *self._call_step(words))

    def check(self) -> None:
        """Wait for callbacks under way and raise the error that one of them met, if any.

        From the error to this call all ticks are zeros. Afterwards the slots can be reset,
        unless a worker process has died: then make a new environment.
        """
        jax.effects_barrier()
        error, self._error = self._error, None
        if error is not None:
            raise error

    def close(self) -> None:
        """End the worker processes."""
        jax.effects_barrier()
        self._pool.close()

    def _guarded(self, host: Callable) -> Callable:
        """`host` over rows of words, int32 [n, W]; its errors are kept and zeros returned."""

        def call(words):
            words = np.asarray(words)
            lead = words.shape[:-1]
            if self._error is None:
                try:
                    tick, time_step = host(words.reshape(-1, words.shape[-1]))
                    rest = np.empty((len(tick), 4), np.int32)
                    rest[:, 0] = tick
                    rest[:, 1] = time_step.reward.astype(np.float32).view(np.int32)
                    rest[:, 2] = time_step.first
                    rest[:, 3] = time_step.terminal
                    image = time_step.image
                    return image.reshape(*lead, *image.shape[1:]), rest.reshape(*lead, 4)
                except BaseException as error:  # KeyboardInterrupt too: `check` raises it
                    self._error = error
            return tuple(np.zeros(lead + x.shape, x.dtype) for x in self._results)

        return call

    def _host_reset(self, words: np.ndarray) -> tuple[np.ndarray, TimeStep]:
        slots, keys = words[:, 0], words[:, 1:].view(np.uint32)
        self._check_slots(slots)
        self._ticks[slots] += 1  # even if the next line fails: earlier tokens are then stale
        time_step = self._pool.reset(slots, keys)
        return self._ticks[slots], time_step

    def _host_step(self, words: np.ndarray) -> tuple[np.ndarray, TimeStep]:
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
        if (bad := ~np.isfinite(actions).all(axis=1)).any():
            raise SimulatorError(
                f"{self._name(slots[bad][0])} got an action that is not finite: {actions[bad][0]}"
            )
        self._ticks[slots] += 1  # even if the next line fails: earlier tokens are then stale
        time_step = self._pool.step(slots, actions)
        return self._ticks[slots], time_step

    def _name(self, slot: int) -> str:
        return f"slot {slot} ({self._pool.tasks[slot].name})"

    def _check_slots(self, slots: np.ndarray) -> None:
        count = len(self._ticks)
        if slots.min() < 0 or slots.max() >= count:
            raise SimulatorError(
                f"got slots {slots.tolist()}, expected 0 to {count - 1} ({self.members} members "
                f"x {len(self.tasks)} tasks)"
            )
        if len(set(slots.tolist())) != len(slots):
            raise SimulatorError(
                f"got slots {slots.tolist()}, of which some are alike: map over slots, so that "
                "every member has its own simulator"
            )
