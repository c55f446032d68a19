"""Environments of several kinds as one, so that an agent plays tasks of all of them.

P population member, K tasks, n rows of one batch, W words of a state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Env, TimeStep
from envs.rows import (
    Layout,
    action_words,
    apply_by_group,
    key_words,
    mapped_rows,
    members_of_shard,
)


class MixedState(NamedTuple):
    """The state of one slot.

    Attributes:
      slot: int32 [].
      part: int32 [W], the words of its environment's own state.
    """

    slot: jax.Array
    part: jax.Array


class MixedEnv:
    """An `Env` made of others, each with P members and some of the K tasks.

    Args:
      parts: the environments, of images and actions of one size.
      places: for each of them, which of the K tasks its own tasks are.
      members: P.
      shards: how many programs play them at once, see `envs.bridge.HostEnv`.
    """

    discrete = False

    def __init__(
        self,
        parts: Sequence[Env],
        places: Sequence[Sequence[int]],
        members: int,
        shards: int = 1,
    ):
        self.parts = tuple(parts)
        self.shards, self._together = shards, members_of_shard(members, shards)
        self.image_size, self.action_size = parts[0].image_size, parts[0].action_size
        self.has_host = any(part.has_host for part in parts)
        self._tasks = sum(map(len, places))
        # For each task, its environment and its number there.
        self._part_of = [0] * self._tasks
        self._numbers = [[-1] * self._tasks for _ in parts]
        self._places = [list(tasks) for tasks in places]
        self._counts = [len(tasks) for tasks in places]
        for index, tasks in enumerate(places):
            for number, task in enumerate(tasks):
                self._part_of[task] = index
                self._numbers[index][task] = number
        slot, key = jnp.int32(0), jnp.zeros(2, jnp.uint32)
        self._layouts = [Layout(jax.eval_shape(part.reset, slot, key)[0]) for part in self.parts]
        self._words = max(layout.size for layout in self._layouts)
        self._reset = mapped_rows(self._reset_rows)
        self._step = mapped_rows(self._step_rows)

    def reset(self, slot: jax.Array, key: jax.Array) -> tuple[MixedState, TimeStep]:
        """Start a phase, seeded by `key` (typed or raw), in `slot` (int32 [])."""
        return self._reset(key_words(slot, key))

    def step(self, state: MixedState, action: jax.Array) -> tuple[MixedState, TimeStep]:
        """One tick with `action` (float32 [A])."""
        return self._step(action_words(state, action, self.action_size))

    def rest(self, slots: np.ndarray) -> None:
        """Let slots idle (bool [P * K]) in the environments whose simulators can."""
        by_task = np.asarray(slots, bool).reshape(-1, self._tasks)
        for part, places in zip(self.parts, self._places, strict=True):
            if hasattr(part, "rest"):
                part.rest(by_task[:, places].reshape(-1))

    def check(self) -> None:
        """Raise the first error that one of the environments met, if any; forget the others."""
        errors = []
        for part in self.parts:
            try:
                part.check()
            except BaseException as error:  # KeyboardInterrupt too
                errors.append(error)
        if errors:
            raise errors[0]

    def hurry(self) -> None:
        """Wait no longer than a few seconds for simulators from now on."""
        for part in self.parts:
            part.hurry()

    def close(self) -> None:
        """Close every environment."""
        for part in self.parts:
            part.close()

    def _by_part(self, function, rows) -> tuple[MixedState, TimeStep]:
        functions = [
            jax.vmap(lambda row, index=index: function(index, row))
            for index in range(len(self.parts))
        ]
        slots = rows[:, 0]
        states, time_step = apply_by_group(functions, self._part_of, self._together, slots, rows)
        return MixedState(slots, states), time_step

    def _reset_rows(self, rows: jax.Array) -> tuple[MixedState, TimeStep]:
        def reset(index, row):
            member, task = row[0] // self._tasks, row[0] % self._tasks
            number = jnp.array(self._numbers[index])[task]
            # A slot of another environment's task can only come from slots that are alike.
            slot = jnp.where(number < 0, -1, member * self._counts[index] + number)
            key = jax.lax.bitcast_convert_type(row[1:], jnp.uint32)
            return self._packed(index, self.parts[index].reset(slot, key))

        return self._by_part(reset, rows)

    def _step_rows(self, rows: jax.Array) -> tuple[MixedState, TimeStep]:
        def step(index, row):
            state = self._layouts[index].unpack(row[1 : 1 + self._words])
            action = jax.lax.bitcast_convert_type(row[1 + self._words :], jnp.float32)
            return self._packed(index, self.parts[index].step(state, action))

        return self._by_part(step, rows)

    def _packed(self, index, result) -> tuple[jax.Array, TimeStep]:
        state, time_step = result
        return self._layouts[index].pack(state, self._words), TimeStep(*time_step)
