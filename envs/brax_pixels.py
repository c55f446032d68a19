"""The six Brax tasks as environments: physics in the graph, and pictures too unless MuJoCo draws.

P population member, K tasks, A action, n rows of one batch, W words of a state, Q joint positions.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import SIMULATOR_TIMEOUT, Outcome, SimulatorError, TaskSpec, TimeStep
from envs.brax_episodes import episodes_of
from envs.brax_physics import physics_of, task_scene
from envs.bridge import HostCalls
from envs.pool import SimulatorPool
from envs.ray_casting import check_size, render
from envs.registry import BRAX_ENGINES, BRAX_RENDERERS
from envs.rows import (
    Layout,
    action_words,
    apply_by_group,
    check_slots,
    key_words,
    mapped_rows,
    members_of_shard,
)


class BraxState(NamedTuple):
    """The state of one slot.

    Attributes:
      slot: int32 [].
      key: uint32 [2], of the phase.
      episode: int32 [], how many episodes of the phase came before.
      ended: int32 [], whether the next tick starts another.
      physics: int32 [W], the words of Brax's state.
    """

    slot: jax.Array
    key: jax.Array
    episode: jax.Array
    ended: jax.Array
    physics: jax.Array


class BraxEnv:
    """An `Env` that is a part of the jitted program, without any host.

    What cannot be simulated gives rewards that are not numbers: an action that is not finite, and
    slots of which some are alike where all P * K are stepped at once.

    Args:
      tasks: K tasks; slot s plays tasks[s % K].
      members: P; there are P * K slots.
      image_size: height and width of the images in pixels.
      action_repeat: environment steps for which an action is held.
      action_size: A, at least the largest |A| of the tasks.
      workers, timeout: not used.
      shards: how many programs play them at once, see `envs.bridge.HostEnv`.

    Raises:
      ValueError: for an image size that is too small.
    """

    discrete = False
    has_host = False

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
        check_size(image_size, self.tasks[0].supersample)
        self.members, self.shards = members, shards
        self._together = members_of_shard(members, shards)
        self.image_size = image_size
        self.action_repeat = action_repeat
        self.action_size = action_size
        self._physics = [physics_of(task.title, task.physics) for task in self.tasks]
        self._episodes = [episodes_of(physics, action_repeat) for physics in self._physics]
        keys = jax.eval_shape(_typed, jax.ShapeDtypeStruct((1, 2), jnp.uint32))
        self._layouts = [
            Layout(jax.tree.map(_row, jax.eval_shape(episodes.begin, keys)))
            for episodes in self._episodes
        ]
        self._words = max(layout.size for layout in self._layouts)
        self._reset = mapped_rows(self._reset_rows)
        self._step = mapped_rows(self._step_rows)

    # It holds nothing that changes: what is compiled for one serves all that are alike.

    def _alike(self) -> tuple:
        return (
            type(self), self.tasks, self.members, self.shards, self.image_size, self.action_repeat,
            self.action_size,
        )  # fmt: skip

    def __eq__(self, other: object) -> bool:
        return isinstance(other, BraxEnv) and self._alike() == other._alike()

    def __hash__(self) -> int:
        return hash(self._alike())

    def reset(self, slot: jax.Array, key: jax.Array) -> tuple[BraxState, TimeStep]:
        """Start a phase, seeded by `key` (typed or raw), in `slot` (int32 [])."""
        return self._reset(key_words(slot, key))

    def before(self, slot: jax.Array, key: jax.Array) -> BraxState:
        """A state whose next step, whatever its action, is what `reset` gives, but for its last
        bits: so a program needs physics and pictures once, and compiles in less time."""
        row, one = key_words(slot, key), jnp.int32(1)
        key = _phase_key(jax.lax.bitcast_convert_type(row[1:], jnp.uint32))
        return BraxState(row[0], key, -one, one, jnp.zeros(self._words, jnp.int32))

    def step(self, state: BraxState, action: jax.Array) -> tuple[BraxState, TimeStep]:
        """One tick with `action` (float32 [A], clipped to [-1, 1])."""
        return self._step(action_words(state, action, self.action_size))

    def check(self) -> None:
        """Nothing: there is no host on which anything could fail."""

    def hurry(self) -> None:
        """Nothing: there is no host to wait for."""

    def close(self) -> None:
        """Nothing: there is no host that holds anything."""

    def _reset_rows(self, rows: jax.Array) -> tuple[BraxState, TimeStep]:
        slots, words = rows[:, 0], jax.lax.bitcast_convert_type(rows[:, 1:], jnp.uint32)
        keys = jax.vmap(_phase_key)(words)
        nothing = jnp.zeros(len(rows), jnp.int32)
        states, views = self._by_task(
            [functools.partial(self._begin, k) for k in range(len(self.tasks))],
            slots,
            (keys, nothing),
        )
        state = BraxState(slots, keys, nothing, nothing, states)
        images, bad = self._images(slots, views, jnp.zeros((len(rows), 0)))
        no = nothing != 0
        return state, TimeStep(images, jnp.where(bad, jnp.nan, jnp.float32(0)), ~no, no)

    def _step_rows(self, rows: jax.Array) -> tuple[BraxState, TimeStep]:
        keys, actions = (
            jax.lax.bitcast_convert_type(part, dtype)
            for part, dtype in (
                (rows[:, 1:3], jnp.uint32),
                (rows[:, 5 + self._words :], jnp.float32),
            )
        )
        slots, episodes, ended = rows[:, 0], rows[:, 3], rows[:, 4] != 0
        states, views, rewards, terminal = self._by_task(
            [functools.partial(self._tick, k) for k in range(len(self.tasks))],
            slots,
            (keys, episodes + 1, ended, rows[:, 5 : 5 + self._words], actions),
        )
        state = BraxState(slots, keys, episodes + ended, terminal.astype(jnp.int32), states)
        images, bad = self._images(slots, views, actions)
        return state, TimeStep(images, jnp.where(bad, jnp.nan, rewards), ended, terminal)

    def _by_task(self, functions, slots, rows):
        return apply_by_group(functions, range(len(self.tasks)), self._together, slots, rows)

    # Traced once for each number of rows, however many mappings are traced above it.
    @functools.partial(jax.jit, static_argnums=(0, 1))
    def _begin(self, task: int, rows):
        """States of task number `task` that start episodes, and their views, for (keys,
        episodes)."""
        return self._seen(task, self._episodes[task].begin(_episode_keys(*rows)))

    @functools.partial(jax.jit, static_argnums=(0, 1))
    def _tick(self, task: int, rows):
        """One tick of task number `task`: states, views, rewards, terminal."""
        keys, next_episodes, ended, words, actions = rows
        states = jax.vmap(self._layouts[task].unpack)(words)
        actions = actions[:, : self._physics[task].action_size]
        keys = _episode_keys(keys, next_episodes)
        states, rewards, terminal = self._episodes[task].tick(states, actions, ended, keys)
        return *self._seen(task, states), rewards, terminal

    def _seen(self, task: int, states) -> tuple[jax.Array, jax.Array]:
        """The words of states of task number `task`, int32 [n, W], and their views."""
        words = jax.vmap(lambda state: self._layouts[task].pack(state, self._words))(states)
        return words, self._views(task, self._episodes[task].physics_state(states))

    def _views(self, task: int, states) -> jax.Array:
        """What there is to see of Brax's states of task number `task`: here, the images."""
        scene, spec = task_scene(self.tasks[task].title), self.tasks[task]

        def drawn(state):
            poses = self._physics[task].poses(state)
            return render(scene, *poses, self.image_size, spec.supersample)

        return jax.vmap(drawn)(states)

    def _images(self, slots, views, actions) -> tuple[jax.Array, jax.Array]:
        """Images of views, and which of them come of what cannot be simulated."""
        bad = ~jnp.isfinite(actions).all(axis=1)
        if len(slots) == self._together * len(self.tasks):
            # Tasks were told apart by the order of the slots.
            expected = jnp.arange(len(slots))
            if self.shards > 1:
                expected += slots.min() // len(slots) * len(slots)
            bad |= (jnp.sort(slots) != expected).any()
        return views, bad


class HostDrawnBraxEnv(BraxEnv):
    """An `Env` whose physics is part of the program; worker processes draw the pictures.

    Args:
      tasks, members, image_size, action_repeat, action_size: as of `BraxEnv`.
      workers: number of processes that draw, by default min(cores, slots).
      timeout: seconds after which one that does not answer is given up.
      shards: how many programs play them at once, see `envs.bridge.HostEnv`.

    Raises:
      ValueError: for an image size that is too small.
      SimulatorError: if there is nothing to draw with, and what to install.
    """

    has_host = True

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
        super().__init__(tasks, members, image_size, action_repeat, action_size, shards=shards)
        self._positions = max(physics.positions for physics in self._physics)
        self._calls = HostCalls()
        self._pool = SimulatorPool(
            [_drawing(task) for task in self.tasks] * members,
            image_size,
            self._positions,
            1,
            workers,
            timeout,
            self._together * len(self.tasks),
        )
        slots = np.arange(members * len(self.tasks))
        self._pool.reset(slots, np.zeros((len(slots), 1), np.uint32))
        self._draw = self._calls.mapped(
            self._host_draw, jax.ShapeDtypeStruct((image_size, image_size, 3), jnp.uint8)
        )

    def check(self) -> None:
        """Wait for callbacks under way and raise the error that one of them met, if any.

        From the error to this call all images are black. A worker process that has died is not
        replaced: then make a new environment.
        """
        self._calls.check()

    def hurry(self) -> None:
        """Wait no longer than a few seconds for pictures from now on."""
        self._pool.hurry()

    def close(self) -> None:
        """End the processes that draw."""
        self.hurry()
        jax.effects_barrier()
        self._pool.close()

    def _alike(self) -> tuple:
        return (id(self),)  # Its processes are its own.

    def _views(self, task: int, states) -> jax.Array:
        """Joint positions float32 [n, Q] of Brax's states of task number `task`."""
        missing = self._positions - self._physics[task].positions
        return jnp.pad(states.q, ((0, 0), (0, missing)))

    def _images(self, slots, views, actions) -> tuple[jax.Array, jax.Array]:
        bad = ~jnp.isfinite(actions).all(axis=1)
        bits = jax.lax.bitcast_convert_type(views.astype(jnp.float32), jnp.int32)
        head = jnp.stack([slots, bad.astype(jnp.int32)], axis=1)
        # The host says what is wrong.
        return jax.vmap(self._draw)(jnp.concatenate([head, bits], axis=1)), jnp.zeros_like(bad)

    def _host_draw(self, rows: np.ndarray) -> np.ndarray:
        slots, bad, positions = rows[:, 0], rows[:, 1] != 0, rows[:, 2:].view(np.float32)
        try:
            check_slots(slots, self.shards * self._together, len(self.tasks))
        except ValueError as error:
            raise SimulatorError(str(error)) from None
        if bad.any():
            slot = slots[bad][0]
            name = self.tasks[slot % len(self.tasks)].name
            raise SimulatorError(f"slot {slot} ({name}) got an action that is not finite")
        drawn = slots < self.members * len(self.tasks)
        if drawn.all():
            return self._pool.step(slots, positions).image
        # What makes up the members of the last shard is looked at by nobody.
        images = np.zeros((len(slots), self.image_size, self.image_size, 3), np.uint8)
        images[drawn] = self._pool.step(slots[drawn], positions[drawn]).image
        return images


def _phase_key(words: jax.Array) -> jax.Array:
    """The words of a key of any kind as one of Brax's: uint32 [words] -> uint32 [2]."""
    key = jax.random.key(0, impl="threefry2x32")
    for word in words:
        key = jax.random.fold_in(key, word)
    return jax.random.key_data(key)


def _typed(keys: jax.Array) -> jax.Array:
    return jax.random.wrap_key_data(keys, impl="threefry2x32")


def _episode_keys(keys: jax.Array, episodes: jax.Array) -> jax.Array:
    return jax.vmap(jax.random.fold_in)(_typed(keys), episodes)


def _row(shape: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
    """The shape of one of n."""
    return jax.ShapeDtypeStruct(shape.shape[1:], shape.dtype)


def _drawing(task: TaskSpec) -> TaskSpec:
    """What a simulator process hosts for a task: it takes joint positions for actions."""
    return replace(
        task,
        action_size=physics_of(task.title, task.physics).positions,
        simulator="envs.mujoco_pictures:Drawing",
    )


class BraxSimulator:
    """One of the six tasks in this process, one step at a time: for `envs.pixel_env`.

    Args:
      title: one of the six names of the thesis, such as "Walker2D".
      image_size: height and width of the rendered images in pixels.
      backend: Brax's engine.
      renderer: "jax" or "mujoco".

    Raises:
      ValueError: for an image size that is too small.
      SimulatorError: if MuJoCo is to draw and finds no driver.
    """

    def __init__(self, title: str, image_size: int, backend: str, renderer: str):
        check_size(image_size)
        self._start, self._step = _compiled(title, backend)
        self._draw = _drawn_by_jax(title, backend, image_size)
        if renderer == "mujoco":
            # Imported here: looking for a driver takes a while.
            from envs.mujoco_pictures import pictures

            drawn = pictures(title, image_size)
            self._draw = lambda states: drawn.draw(np.asarray(states.q)[0])
        self._state: Any = None

    def reset(self, seed: int) -> None:
        """Start an episode with joint angles drawn from `seed` (any non-negative integer)."""
        words = np.random.SeedSequence(seed).generate_state(2)
        self._state = self._start(words)

    def step(self, action: np.ndarray) -> Outcome:
        """Advance by one environment step."""
        self._state, reward, terminal = self._step(self._state, np.asarray(action, np.float32))
        return Outcome(float(reward), bool(terminal))

    def render(self) -> np.ndarray:
        """The present picture, uint8 [image_size, image_size, 3]."""
        return np.array(self._draw(self._state))

    def close(self) -> None:
        """Forget the state."""
        self._state = None


@functools.cache
def _compiled(title: str, backend: str):
    """The first state and an environment step of n = 1 episodes."""
    episodes = episodes_of(physics_of(title, backend), 1)

    def step(states, action):
        keys = _typed(jnp.zeros((1, 2), jnp.uint32))
        states, rewards, terminal = episodes.tick(states, action[None], jnp.zeros(1, bool), keys)
        return states, rewards[0], terminal[0]

    return jax.jit(lambda words: episodes.begin(_typed(words)[None])), jax.jit(step)


@functools.cache
def _drawn_by_jax(title: str, backend: str, image_size: int):
    physics = physics_of(title, backend)
    episodes = episodes_of(physics, 1)

    def draw(states):
        state = jax.tree.map(lambda x: x[0], episodes.physics_state(states))
        return render(task_scene(title), *physics.poses(state), image_size)

    return jax.jit(draw)


# The simulators of each engine and renderer, to be found by name.
simulators = SimpleNamespace(
    **{
        backend: SimpleNamespace(
            **{
                renderer: functools.partial(BraxSimulator, backend=backend, renderer=renderer)
                for renderer in BRAX_RENDERERS
            }
        )
        for backend in BRAX_ENGINES
    }
)
