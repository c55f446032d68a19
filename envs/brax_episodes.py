"""Episodes of one Brax task, many at a time: held actions, and new starts after falls.

n slots, A action. What happens at a tick is decided for all slots together, so that the costly
parts are done only if one of them needs them, and stand in the program once: a step of Brax's
generalized engine is thousands of operations, and to compile them takes longer than to run them.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.brax_physics import Physics, brax_state, quiet

# isort: split
# After the module above, which keeps what Brax says on import to itself.
from brax import actuator, kinematics
from brax.generalized import constraint, dynamics, integrator, mass


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
    """A state of the generalized engine.

    Attributes:
        physics: Brax's state.
        stale: bool [], only positions, velocities and poses are known yet.
    """

    physics: Any
    stale: jax.Array


class GeneralizedEpisodes(Episodes):
    """Episodes in Brax's generalized engine, whose step is written out once.

    Brax has the same chain of operations at the end of a step as in the making of a new state: from
    positions and velocities to all that the next step needs. Here new starts go through the
    chain of the step, in a pass of its own that is made only if there are any.
    """

    def __init__(self, physics: Physics, repeat: int):
        super().__init__(physics, repeat)
        self._system, self._env = physics.env.sys, physics.env
        empty = jax.eval_shape(physics.start, jax.random.key(0))
        self._empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), empty)

    def begin(self, keys: jax.Array) -> _Held:
        def one(key):
            state = self._drawn(key)
            x, xd = kinematics.forward(self._system, state.q, state.qd)
            return _Held(state.replace(x=x, xd=xd), jnp.bool_(True))

        return jax.vmap(one)(keys)

    def physics_state(self, state: _Held) -> Any:
        return state.physics

    def tick(self, states, actions, ended, keys):
        before = jax.lax.cond(
            ended.any(),
            lambda: _chosen(ended, jax.vmap(self._drawn)(keys), states.physics),
            lambda: states.physics,
        )
        new = ended | states.stale
        actions = jnp.clip(actions, -1.0, 1.0)
        commands = jax.vmap(self._command)(before, actions)

        def environment_step(carry, index):
            before, rewards, over = carry
            first = jnp.where((index == 0) & new.any(), -1, 0)

            def physics_step(number, state):
                moved = self._physics_step(state, commands, number < 0)
                return _chosen(jnp.where(number < 0, new, ~over & ~ended), moved, state)

            after = jax.lax.fori_loop(first, self._env._n_frames, physics_step, before)
            judged, reward, terminal = jax.vmap(self._outcome)(before, after, actions)
            # A start is no step to be judged.
            after = _chosen(ended, after, judged)
            return (after, rewards + jnp.where(over, 0.0, reward), over | terminal), None

        nothing = jnp.zeros(len(ended))
        with quiet():
            (after, rewards, over), _ = jax.lax.scan(
                environment_step, (before, nothing, nothing != 0), jnp.arange(self._repeat)
            )
        stale = jnp.zeros_like(ended)
        return _Held(after, stale), jnp.where(ended, 0.0, rewards), over & ~ended

    def _physics_step(self, states, commands, starting):
        """One physics step of n states; or, if `starting`, what follows from where they are."""
        system = self._system

        def moved(state, command):
            torques = actuator.to_tau(system, command, state.q, state.qd)
            new = state.replace(qf_smooth=dynamics.forward(system, state, torques))
            new = new.replace(qf_constraint=constraint.force(system, new))
            return integrator.integrate(system, new)

        def placed(state):
            x, xd = kinematics.forward(system, state.q, state.qd)
            return dynamics.transform_com(system, state.replace(x=x, xd=xd))

        states = _where(starting, states, jax.vmap(moved)(states, commands))
        states = jax.vmap(placed)(states)
        states = jax.lax.cond(
            starting,
            jax.vmap(lambda state: mass.matrix_inv(system, state, 0)),
            jax.vmap(lambda state: mass.matrix_inv(system, state, system.matrix_inv_iterations)),
            states,
        )
        return jax.vmap(lambda state: constraint.jacobian(system, state))(states)

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


def episodes_of(physics: Physics, repeat: int) -> Episodes:
    """The episodes of a task's physics, the quickest to compile that there are for its engine."""
    kind = GeneralizedEpisodes if physics.backend == "generalized" else Episodes
    return kind(physics, repeat)


def _standing_in(env, **methods: Callable):
    env = copy.copy(env)
    for name, method in methods.items():
        setattr(env, name, method)
    return env


def _chosen(chosen: jax.Array, new, old):
    """Leaves [n, ...] of `new` where `chosen` (bool [n]), else of `old`."""

    def one(x, y):
        return jnp.where(chosen.reshape(-1, *[1] * (x.ndim - 1)), x, y)

    return jax.tree.map(one, new, old)


def _where(condition: jax.Array, new, old):
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), new, old)
