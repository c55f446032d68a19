"""The six Brax tasks: physics in the graph, pictures through one ordered host callback.

P population member, K tasks, A action, n rows of one batch, W words of a state, Q joint positions.
Models and dynamics are those of the package `brax`, as are the rewards of locomotion; the two
pendula are the swing-ups of the thesis (equations 24 and 25).
"""

from __future__ import annotations

import contextlib
import functools
import io
import warnings
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Outcome, SimulatorError, TaskSpec, TimeStep
from envs.bridge import HostCalls
from envs.mujoco_pictures import model_xml, pictures
from envs.pool import SimulatorPool
from envs.rows import (
    Layout,
    action_words,
    apply_by_group,
    check_slots,
    key_words,
    mapped_rows,
)

# Brax says on import that `warp` is missing, which nothing here needs.
with contextlib.redirect_stdout(io.StringIO()):
    from brax.envs import get_environment
    from brax.envs.base import PipelineEnv, State
    from brax.io import mjcf

_BRAX_NAMES = {
    "Ant": "ant",
    "HalfCheetah": "halfcheetah",
    "Hopper": "hopper",
    "Walker2D": "walker2d",
}

# Physics steps in an environment step, of the backends that integrate rigid bodies as MuJoCo does
# ("generalized" and "mjx") and of those that need shorter steps ("spring" and "positional").
_PHYSICS_STEPS = {
    "Ant": (2, 4),
    "HalfCheetah": (2, 6),
    "Hopper": (8, 8),
    "Walker2D": (8, 8),
    "InvertedPendulum": (4, 4),
    "InvertedDoublePendulum": (8, 8),
}
_SHORT_STEPS = ("spring", "positional")

# Newtons with which an action of 1 pushes the cart: of the pendulum what its model's motor has, of
# the double pendulum what PyBullet's has, for its model's 500 would drive it into the ends of the
# rail faster than "generalized" and "mjx" can follow.
_PUSH = {"InvertedPendulum": 300.0, "InvertedDoublePendulum": 200.0}


@contextlib.contextmanager
def _quiet():
    """Keeps what Brax has to say of its age, and of MuJoCo's, to itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


class _Swingup(PipelineEnv):
    """A pendulum on a cart, of one pole or two, that starts hanging and never ends."""

    def __init__(self, title: str, backend: str, n_frames: int):
        system = mjcf.loads(model_xml(title))
        # PyBullet's time step. Physics steps of the models' own 10 and 20 ms gain energy when the
        # cart meets an end of the rail, until nothing is finite.
        system = system.tree_replace({"opt.timestep": TaskSpec.step_seconds / n_frames})
        self._push = _PUSH[title] / system.actuator.gear
        super().__init__(system, backend=backend, n_frames=n_frames)

    def reset(self, rng: jax.Array) -> State:
        """Still, hanging but for an angle of each joint in U(-0.1, 0.1)."""
        hinges = self.sys.q_size() - 1
        angles = jax.random.uniform(rng, (hinges,), minval=-0.1, maxval=0.1).at[0].add(jnp.pi)
        positions = self.sys.init_q.at[1:].set(angles)
        physics = self.pipeline_init(positions, jnp.zeros(self.sys.qd_size()))
        return State(physics, None, jnp.float32(0), jnp.float32(0))

    def step(self, state: State, action: jax.Array) -> State:
        """Push the cart with `action` of the greatest force; reward: the sum of the cosines of the
        joint's positions, the second relative to the first pole."""
        physics = self.pipeline_step(state.pipeline_state, action * self._push)
        return state.replace(pipeline_state=physics, reward=jnp.cos(physics.q[1:]).sum())


class Physics:
    """One task's dynamics as pure functions of Brax's state.

    Attributes:
        action_size: |A|.
        positions: Q.
        seconds: simulated time of one `step`.

    Args:
        title: one of the six names of the thesis, such as "Walker2D".
        backend: Brax's engine: "generalized", "spring", "positional" or "mjx".
    """

    def __init__(self, title: str, backend: str):
        steps = _PHYSICS_STEPS[title][backend in _SHORT_STEPS]
        with _quiet():
            if title in _BRAX_NAMES:
                env = get_environment(_BRAX_NAMES[title], backend=backend, n_frames=steps)
            else:
                env = _Swingup(title, backend, steps)
        self._env = env
        self.action_size = env.action_size
        self.positions = env.sys.q_size()
        self.seconds = float(env.dt)

    def start(self, key: jax.Array) -> Any:
        """The state in which an episode starts."""
        with _quiet():
            return self._env.reset(key).pipeline_state

    def step(self, state: Any, action: jax.Array) -> tuple[Any, jax.Array, jax.Array]:
        """Advance by one environment step with `action` (float32 [|A|], clipped to [-1, 1]).

        Returns:
            The state, the reward and whether the episode ended. A state in which the engine
            has diverged ends it too, without reward, and is replaced by the one before.
        """
        before = State(state, None, jnp.float32(0), jnp.float32(0), {}, {})
        with _quiet():
            after = self._env.step(before, jnp.clip(action, -1.0, 1.0))
        new, reward = after.pipeline_state, jnp.float32(after.reward)
        finite = jnp.isfinite(jnp.concatenate([new.q, new.qd, reward[None]])).all()
        new = jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, state)
        return new, jnp.where(finite, reward, 0.0), ~finite | (after.done > 0.5)

    def hold(self, state: Any, action: jax.Array, repeat: int):
        """`repeat` steps with one action, fewer if the episode ends; rewards are summed."""

        def one(carry, _):
            state, total, over = carry
            new, reward, terminal = self.step(state, action)
            new = jax.tree.map(lambda a, b: jnp.where(over, a, b), state, new)
            return (new, total + jnp.where(over, 0.0, reward), over | terminal), None

        return jax.lax.scan(one, (state, jnp.float32(0), jnp.bool_(False)), None, repeat)[0]


@functools.cache
def physics_of(title: str, backend: str) -> Physics:
    """One `Physics` for all who ask for it: models take a while to load."""
    return Physics(title, backend)


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
    """An `Env` whose physics is part of the program; worker processes draw the pictures.

    Args:
        tasks: K tasks; slot s plays tasks[s % K].
        members: P; there are P * K slots.
        image_size: height and width of the images in pixels.
        action_repeat: environment steps for which an action is held.
        action_size: A, at least the largest |A| of the tasks.
        workers: number of processes that draw, by default min(cores, slots).

    Raises:
        SimulatorError: if there is nothing to draw with, and what to install.
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
        self._physics = [physics_of(task.title, task.physics) for task in self.tasks]
        self._layouts = [
            Layout(jax.eval_shape(physics.start, jax.random.key(0))) for physics in self._physics
        ]
        self._words = max(layout.size for layout in self._layouts)
        self._positions = max(physics.positions for physics in self._physics)
        self._calls = HostCalls()
        self._pool = SimulatorPool(
            [_drawing(task) for task in self.tasks] * members,
            image_size,
            self._positions,
            1,
            workers,
        )
        slots = np.arange(members * len(self.tasks))
        self._pool.reset(slots, np.zeros((len(slots), 1), np.uint32))
        self._draw = self._calls.mapped(
            self._host_draw, jax.ShapeDtypeStruct((image_size, image_size, 3), jnp.uint8)
        )
        self._reset = mapped_rows(self._reset_rows)
        self._step = mapped_rows(self._step_rows)

    def reset(self, slot: jax.Array, key: jax.Array) -> tuple[BraxState, TimeStep]:
        """Start a phase, seeded by `key` (typed or raw), in `slot` (int32 [])."""
        return self._reset(key_words(slot, key))

    def step(self, state: BraxState, action: jax.Array) -> tuple[BraxState, TimeStep]:
        """One tick with `action` (float32 [A], clipped to [-1, 1])."""
        return self._step(action_words(state, action, self.action_size))

    def check(self) -> None:
        """Wait for callbacks under way and raise the error that one of them met, if any.

        From the error to this call all images are black. A worker process that has died is not
        replaced: then make a new environment.
        """
        self._calls.check()

    def close(self) -> None:
        """End the processes that draw."""
        jax.effects_barrier()
        self._pool.close()

    def _reset_rows(self, rows: jax.Array) -> tuple[BraxState, TimeStep]:
        slots, words = rows[:, 0], jax.lax.bitcast_convert_type(rows[:, 1:], jnp.uint32)
        keys = jax.vmap(_phase_key)(words)
        nothing = jnp.zeros(len(rows), jnp.int32)
        states, positions = self._by_task(
            [functools.partial(self._start, k) for k in range(len(self.tasks))],
            slots,
            (keys, nothing),
        )
        state = BraxState(slots, keys, nothing, nothing, states)
        image = self._pictures(slots, positions, jnp.zeros((len(rows), 0)))
        no = nothing != 0
        return state, TimeStep(image, jnp.zeros(len(rows), jnp.float32), ~no, no)

    def _step_rows(self, rows: jax.Array) -> tuple[BraxState, TimeStep]:
        keys, actions = (
            jax.lax.bitcast_convert_type(part, dtype)
            for part, dtype in (
                (rows[:, 1:3], jnp.uint32),
                (rows[:, 5 + self._words :], jnp.float32),
            )
        )
        slots, episodes, ended = rows[:, 0], rows[:, 3], rows[:, 4] != 0
        states, positions, rewards, terminal = self._by_task(
            [functools.partial(self._tick, k) for k in range(len(self.tasks))],
            slots,
            (keys, episodes + 1, ended, rows[:, 5 : 5 + self._words], actions),
        )
        state = BraxState(slots, keys, episodes + ended, terminal.astype(jnp.int32), states)
        image = self._pictures(slots, positions, actions)
        return state, TimeStep(image, rewards, ended, terminal)

    def _by_task(self, functions, slots, rows):
        return apply_by_group(functions, range(len(self.tasks)), self.members, slots, rows)

    # Traced once for each number of rows, however many mappings are traced above it.
    @functools.partial(jax.jit, static_argnums=(0, 1))
    def _start(self, task: int, rows) -> tuple[jax.Array, jax.Array]:
        """States of task number `task` that start episodes, and positions, for (keys, episodes)."""
        keys, episodes = rows
        episode_keys = jax.vmap(jax.random.fold_in)(_typed(keys), episodes)
        return self._packed(task, jax.vmap(self._physics[task].start)(episode_keys))

    def _packed(self, task: int, states) -> tuple[jax.Array, jax.Array]:
        layout, missing = self._layouts[task], self._positions - self._physics[task].positions
        words = jax.vmap(lambda state: layout.pack(state, self._words))(states)
        return words, jnp.pad(states.q, ((0, 0), (0, missing)))

    @functools.partial(jax.jit, static_argnums=(0, 1))
    def _tick(self, task: int, rows):
        """One tick of task number `task`: states, positions, rewards, terminal."""
        keys, next_episodes, ended, words, actions = rows
        physics = self._physics[task]
        states = jax.vmap(self._layouts[task].unpack)(words)
        hold = functools.partial(physics.hold, repeat=self.action_repeat)
        states, rewards, terminal = jax.vmap(hold)(states, actions[:, : physics.action_size])
        moved = self._packed(task, states)

        def restarted():
            return jax.tree.map(
                lambda new, old: jnp.where(ended[:, None], new, old),
                self._start(task, (keys, next_episodes)),
                moved,
            )

        # Falls are rare, and a start costs as much as a step.
        words, positions = jax.lax.cond(ended.any(), restarted, lambda: moved)
        return words, positions, jnp.where(ended, 0.0, rewards), terminal & ~ended

    def _pictures(self, slots, positions, actions) -> jax.Array:
        bad = ~jnp.isfinite(actions).all(axis=1)
        bits = jax.lax.bitcast_convert_type(positions.astype(jnp.float32), jnp.int32)
        head = jnp.stack([slots, bad.astype(jnp.int32)], axis=1)
        return jax.vmap(self._draw)(jnp.concatenate([head, bits], axis=1))

    def _host_draw(self, rows: np.ndarray) -> np.ndarray:
        slots, bad, positions = rows[:, 0], rows[:, 1] != 0, rows[:, 2:].view(np.float32)
        try:
            check_slots(slots, self.members, len(self.tasks))
        except ValueError as error:
            raise SimulatorError(str(error)) from None
        if bad.any():
            slot = slots[bad][0]
            name = self.tasks[slot % len(self.tasks)].name
            raise SimulatorError(f"slot {slot} ({name}) got an action that is not finite")
        return self._pool.step(slots, positions).image


def _phase_key(words: jax.Array) -> jax.Array:
    """The words of a key of any kind as one of Brax's: uint32 [words] -> uint32 [2]."""
    key = jax.random.key(0, impl="threefry2x32")
    for word in words:
        key = jax.random.fold_in(key, word)
    return jax.random.key_data(key)


def _typed(keys: jax.Array) -> jax.Array:
    return jax.random.wrap_key_data(keys, impl="threefry2x32")


def _drawing(task: TaskSpec) -> TaskSpec:
    """What a simulator process hosts for a task: it takes joint positions for actions."""
    return TaskSpec(
        name=task.name,
        title=task.title,
        action_size=physics_of(task.title, task.physics).positions,
        simulator="envs.mujoco_pictures:Drawing",
        gymnasium_id=task.gymnasium_id,
    )


class BraxSimulator:
    """One of the six tasks in this process, one step at a time: for `envs.pixel_env`.

    Args:
        title: one of the six names of the thesis, such as "Walker2D".
        image_size: height and width of the rendered images in pixels.
        backend: Brax's engine.
    """

    def __init__(self, title: str, image_size: int, backend: str):
        self._physics = physics_of(title, backend)
        self._start, self._step = _compiled(title, backend)
        self._pictures = pictures(title, image_size)
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
        return self._pictures.draw(np.asarray(self._state.q))

    def close(self) -> None:
        """Forget the state."""
        self._state = None


@functools.cache
def _compiled(title: str, backend: str):
    physics = physics_of(title, backend)
    start = jax.jit(lambda words: physics.start(_typed(words)))
    return start, jax.jit(physics.step)


# The simulators of each backend, to be found by name.
simulators = SimpleNamespace(
    **{
        backend: functools.partial(BraxSimulator, backend=backend)
        for backend in ("generalized", "spring", "positional", "mjx")
    }
)
