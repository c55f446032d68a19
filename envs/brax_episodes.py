"""Episodes of one Brax task, many at a time: held actions, and new starts after falls.

n slots, A action. What happens at a tick is decided for all slots together, so that the costly
parts are done only if one of them needs them, and stand in the program once: a step of Brax's
generalized engine is thousands of operations, and to compile them takes longer than to run them.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.brax_chain import Chain
from envs.brax_forces import Forces
from envs.brax_physics import Physics, brax_state, quiet

# isort: split
# After the module above, which keeps what Brax says on import to itself.
from brax.base import Motion, Transform
from brax.generalized.base import State


class Episodes:
    """Episodes of any physics.

    Args:
      physics: of the task.
      repeat: environment steps for which an action is held.
    """

    def __init__(self, physics: Physics, repeat: int):
        self._physics = physics
        self._repeat = repeat

    def begin(self, keys: jax.Array) -> Any:
        """The states in which episodes start, for n typed keys: leaves [n, ...]."""
        return jax.vmap(self._physics.start)(keys)

    def tick(
        self, states: Any, actions: jax.Array, ended: jax.Array, keys: jax.Array
    ) -> tuple[Any, jax.Array, jax.Array]:
        """Hold actions, fewer steps if an episode ends; start another where one has ended.

        Args:
          states: leaves [n, ...].
          actions: float32 [n, |A|].
          ended: bool [n], whose episodes ended at the tick before: they start anew instead.
          keys: n typed keys, of the episodes that would be next.

        Returns:
          States, rewards float32 [n] and whether episodes ended, bool [n]; a start has neither.
        """
        hold = jax.vmap(lambda state, action: self._physics.hold(state, action, self._repeat))
        moved, rewards, terminal = hold(states, actions)
        # Falls are rare, and a start costs as much as a step.
        states = jax.lax.cond(
            ended.any(), lambda: _chosen(ended, self.begin(keys), moved), lambda: moved
        )
        return states, jnp.where(ended, 0.0, rewards), terminal & ~ended

    def physics_state(self, state: Any) -> Any:
        """Brax's state in one of ours."""
        return state


class _Held(NamedTuple):
    """States of the generalized engine, as much of each as the next step and the picture need.

    Attributes:
      q: float32 [n, Q], joint positions.
      qd: float32 [n, D], joint velocities.
      positions: float32 [n, L, 3], of links.
      quaternions: float32 [n, L, 4].
    """

    q: jax.Array
    qd: jax.Array
    positions: jax.Array
    quaternions: jax.Array


class GeneralizedEpisodes(Episodes):
    """Episodes in Brax's generalized engine, whose step is written out once.

    Brax ends a step, and the making of a state, with all that the next step needs. Here a step
    begins with that, so that positions and velocities are all that passes from one to the next,
    and a start needs no more than a draw of these.
    """

    def __init__(self, physics: Physics, repeat: int):
        super().__init__(physics, repeat)
        self._env = physics.env
        self._chain = Chain(physics.env.sys)
        self._forces = Forces(physics.env.sys, self._chain)
        system = physics.env.sys
        links = (system.num_links(),)
        nothing = np.zeros(system.q_size(), np.float32), np.zeros(system.qd_size(), np.float32)
        # What a step of Brax's would find beside this is not read, and takes a second to trace.
        self._empty = State.init(*nothing, Transform.zero(links), Motion.zero(links))

    def begin(self, keys: jax.Array) -> _Held:
        drawn = jax.vmap(self._drawn)(keys)
        return self._placed(drawn.q, drawn.qd)

    def _placed(self, q: jax.Array, qd: jax.Array) -> _Held:
        """States with the places of links as their joints say."""
        places = self._chain.places(q)
        return _Held(q, qd, places.positions, places.quaternions)

    def physics_state(self, state: _Held) -> Any:
        def one(state):
            places = Transform(state.positions, state.quaternions)
            return self._empty.replace(q=state.q, qd=state.qd, x=places)

        return jax.vmap(one)(state)

    def tick(self, states, actions, ended, keys):
        def started():
            # Not moved, but placed by the steps of the others.
            return _chosen(ended, _held(jax.vmap(self._drawn)(keys)), states)

        states = jax.lax.cond(ended.any(), started, lambda: states)
        actions = jnp.clip(actions, -1.0, 1.0)
        commands = jax.vmap(self._command)(self.physics_state(states), actions)

        def environment_step(carry, _):
            before, rewards, over = carry

            def physics_step(_, moving):
                return _chosen(over | ended, moving, self._physics_step(moving, commands))

            moving = (before.q, before.qd)
            after = self._placed(*jax.lax.fori_loop(0, self._env._n_frames, physics_step, moving))
            judged, reward, terminal = jax.vmap(self._outcome)(
                self.physics_state(before), self.physics_state(after), actions
            )
            kept = _chosen(ended, after, _held(judged))
            return (kept, rewards + jnp.where(over, 0.0, reward), over | terminal), None

        nothing = jnp.zeros(len(ended))
        with quiet():
            (after, rewards, over), _ = jax.lax.scan(
                environment_step, (states, nothing, nothing != 0), None, self._repeat
            )
        return after, jnp.where(ended, 0.0, rewards), over & ~ended

    def _physics_step(self, moving, commands):
        """Positions and velocities of n states after one physics step."""
        q, qd = moving
        places = self._chain.places(q)
        return self._forces.moved(q, qd, places, self._chain.motions(places, qd), commands)

    # What Brax's environment adds to its engine, found out by standing in for the engine.

    def _drawn(self, key):
        """A state at the positions and velocities in which an episode starts, and no more."""
        env = _standing_in(
            self._env, pipeline_init=lambda q, qd, *_: self._empty.replace(q=q, qd=qd)
        )
        return env.reset(key).pipeline_state

    def _command(self, state, action):
        """What the environment hands to the engine for an action."""
        commands = []

        def pipeline_step(state, command):
            commands.append(command)
            return state

        _standing_in(self._env, pipeline_step=pipeline_step).step(brax_state(state), action)
        return commands[0]

    def _outcome(self, before, after, action):
        """State, reward and whether the episode ended, of a step that the engine has made."""
        env = _standing_in(self._env, pipeline_step=lambda *_: after)
        return self._physics.judged(before, env.step(brax_state(before), action))


@functools.cache
def episodes_of(physics: Physics, repeat: int) -> Episodes:
    """The episodes of a task's physics, the quickest to compile that there are for its engine.

    The same ones for all who ask for them: they take a while to make.
    """
    kind = GeneralizedEpisodes if physics.backend == "generalized" else Episodes
    return kind(physics, repeat)


def _standing_in(env, **methods: Callable):
    env = copy.copy(env)
    for name, method in methods.items():
        setattr(env, name, method)
    return env


def _held(state) -> _Held:
    """What is held of n of Brax's states."""
    return _Held(state.q, state.qd, state.x.pos, state.x.rot)


def _chosen(chosen: jax.Array, new, old):
    """Leaves [n, ...] of `new` where `chosen` (bool [n]), else of `old`."""

    def one(x, y):
        return jnp.where(chosen.reshape(-1, *[1] * (x.ndim - 1)), x, y)

    return jax.tree.map(one, new, old)
