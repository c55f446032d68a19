"""Host simulators as an `Env`: the only file that knows callbacks.

P population member, K tasks, A action. A jitted program reaches a simulator through an ordered
host callback. JAX refuses to vmap those, so each is wrapped in `custom_vmap`, whose rule hands the
whole batch to the same callback once more: however many axes are mapped, one tick is one call.
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
        host: called with arrays that share leading axes `lead` (those of the first argument,
            otherwise a scalar), returns results of shapes lead + the shapes of `results`.
        results: tree of `jax.ShapeDtypeStruct`, the results for one simulator.
    """

    @custom_vmap
    def call(*arguments):
        lead = arguments[0].shape
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(lead + x.shape, x.dtype), results)
        return io_callback(host, shapes, *arguments, ordered=True)

    @call.def_vmap
    def _(axis_size, in_batched, *arguments):
        arguments = [
            x if batched else jnp.broadcast_to(x, (axis_size, *x.shape))
            for x, batched in zip(arguments, in_batched, strict=True)
        ]
        out = call(*arguments)
        return out, jax.tree.map(lambda _: True, out)

    return call


class HostEnv:
    """An `Env` over simulators that live in worker processes.

    Args:
        tasks: K tasks; slot s plays tasks[s % K].
        members: P; there are P * K slots.
        image_size: height and width of the images in pixels.
        action_repeat: environment steps for which an action is held.
        action_size: A, at least the largest |A| of the tasks.
        workers: number of worker processes, by default min(cores, slots).
    """

    discrete = False

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
        self._error: BaseException | None = None
        self._ticks = np.full(members * len(self.tasks), -1, np.int32)
        self._pool = SimulatorPool(
            self.tasks * members, image_size, action_size, action_repeat, workers
        )
        time_step = TimeStep(
            image=jax.ShapeDtypeStruct((image_size, image_size, 3), jnp.uint8),
            reward=jax.ShapeDtypeStruct((), jnp.float32),
            first=jax.ShapeDtypeStruct((), jnp.bool_),
            terminal=jax.ShapeDtypeStruct((), jnp.bool_),
        )
        tick = jax.ShapeDtypeStruct((), jnp.int32)
        self._results = (tick, time_step)
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
        tick, time_step = self._call_reset(slot, key)
        return Token(slot, tick), time_step

    def step(self, state: Token, action: jax.Array) -> tuple[Token, TimeStep]:
        """One tick with `action` (float32 [A], clipped to [-1, 1])."""
        if action.shape != (self.action_size,):
            raise ValueError(
                f"got an action of shape {action.shape}, expected {(self.action_size,)}: "
                "map over several simulators with jax.vmap"
            )
        tick, time_step = self._call_step(*state, jnp.asarray(action, jnp.float32))
        return Token(state.slot, tick), time_step

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
        """`host` over flat batches of NumPy arrays; its errors are kept and zeros returned."""

        def call(slot, *others):
            slot = np.asarray(slot)
            lead, count = slot.shape, slot.size
            if self._error is None:
                try:
                    others = [np.asarray(x) for x in others]
                    others = [x.reshape(count, *x.shape[len(lead) :]) for x in others]
                    tick, time_step = host(slot.reshape(count), *others)
                    return tick.reshape(lead), TimeStep(
                        *(leaf.reshape(lead + leaf.shape[1:]) for leaf in time_step)
                    )
                except BaseException as error:  # KeyboardInterrupt too: `check` raises it
                    self._error = error
            return jax.tree.map(lambda x: np.zeros(lead + x.shape, x.dtype), self._results)

        return call

    def _host_reset(self, slots: np.ndarray, keys: np.ndarray) -> tuple[np.ndarray, TimeStep]:
        self._check_slots(slots)
        self._ticks[slots] += 1  # even if the next line fails: earlier tokens are then stale
        time_step = self._pool.reset(slots, keys)
        return self._ticks[slots], time_step

    def _host_step(
        self, slots: np.ndarray, ticks: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, TimeStep]:
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
