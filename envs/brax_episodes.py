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

from envs.brax_chain import Chain
from envs.brax_physics import Physics, brax_state, quiet

# isort: split
# After the module above, which keeps what Brax says on import to itself.
from brax import actuator
from brax.base import Inertia, Motion, Transform
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
    """States of the generalized engine, as much of each as the next step needs.

    Attributes:
      q: float32 [n, Q], joint positions.
      qd: float32 [n, D], joint velocities.
      inverse: float32 [n, D, D], of the mass matrix, as the last step knew it.
      positions: float32 [n, L, 3], of links.
      quaternions: float32 [n, L, 4].
      new: bool [n], no step was made: the inverse is not known.
    """

    q: jax.Array
    qd: jax.Array
    inverse: jax.Array
    positions: jax.Array
    quaternions: jax.Array
    new: jax.Array


class GeneralizedEpisodes(Episodes):
    """Episodes in Brax's generalized engine, whose step is written out once.

    Brax ends a step, and the making of a state, with all that the next step needs. Here a step
    begins with that, so that positions, velocities and the inverse of the mass matrix are all
    that passes from one to the next, and a start needs no more than a draw of these.
    """

    def __init__(self, physics: Physics, repeat: int):
        super().__init__(physics, repeat)
        self._system, self._env = physics.env.sys, physics.env
        self._chain = Chain(self._system)
        empty = jax.eval_shape(physics.start, jax.random.key(0))
        self._empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), empty)

    def begin(self, keys: jax.Array) -> _Held:
        return self._placed(self._starts(keys))

    def _starts(self, keys: jax.Array) -> _Held:
        """Where n episodes start, the places of links not known yet."""
        drawn = jax.vmap(self._drawn)(keys)
        return _held(drawn, jnp.ones(len(drawn.q), bool))

    def _placed(self, states: _Held) -> _Held:
        """States with the places of links as their joints say."""
        places = self._chain.places(states.q)
        return states._replace(positions=places.positions, quaternions=places.quaternions)

    def physics_state(self, state: _Held) -> Any:
        def one(state):
            places = Transform(state.positions, state.quaternions)
            return self._empty.replace(q=state.q, qd=state.qd, x=places, mass_mx_inv=state.inverse)

        return jax.vmap(one)(state)

    def tick(self, states, actions, ended, keys):
        # Starts are not moved, but placed by the steps of the others.
        states = jax.lax.cond(
            ended.any(), lambda: _chosen(ended, self._starts(keys), states), lambda: states
        )
        actions = jnp.clip(actions, -1.0, 1.0)
        commands = jax.vmap(self._command)(self.physics_state(states), actions)

        def environment_step(carry, _):
            before, rewards, over = carry

            def physics_step(_, state):
                moved = self._physics_step(state, commands)
                return _chosen(over | ended, state, moved)

            after = jax.lax.fori_loop(0, self._env._n_frames, physics_step, before)
            after = self._placed(after)
            judged, reward, terminal = jax.vmap(self._outcome)(
                self.physics_state(before), self.physics_state(after), actions
            )
            kept = _chosen(ended, after, _held(judged, after.new))
            return (kept, rewards + jnp.where(over, 0.0, reward), over | terminal), None

        nothing = jnp.zeros(len(ended))
        with quiet():
            (after, rewards, over), _ = jax.lax.scan(
                environment_step, (states, nothing, nothing != 0), None, self._repeat
            )
        return after, jnp.where(ended, 0.0, rewards), over & ~ended

    def _physics_step(self, states: _Held, commands: jax.Array) -> _Held:
        """One physics step of n states."""
        system = self._system
        places = self._chain.places(states.q)
        motions = self._chain.motions(places, states.qd)
        links = len(system.link_parents)

        def known(state, place, motion):
            return self._empty.replace(
                q=state.q,
                qd=state.qd,
                x=Transform(place.positions, place.quaternions),
                root_com=jnp.tile(motion.centre, (links, 1)),
                cinr=Inertia(
                    # The quaternions of inertias are not looked at.
                    Transform(motion.moments, jnp.zeros((links, 4))),
                    motion.inertia,
                    system.link.inertia.mass,
                ),
                cd=Motion(motion.link_turns, motion.link_moves),
                cdof=Motion(motion.turns, motion.moves),
                cdofd=Motion(motion.turns_rate, motion.moves_rate),
                mass_mx_inv=state.inverse,
            )

        def moved(state, command):
            state = constraint.jacobian(system, state)
            torques = actuator.to_tau(system, command, state.q, state.qd)
            state = state.replace(qf_smooth=dynamics.forward(system, state, torques))
            state = state.replace(qf_constraint=constraint.force(system, state))
            return integrator.integrate(system, state)

        before = jax.vmap(known)(states, places, motions)
        before = self._inverted(before, states.new)
        after = jax.vmap(moved)(before, commands)
        return _held(after, jnp.zeros_like(states.new))

    def _inverted(self, states, new: jax.Array):
        """States with their mass matrices and the inverses of these: made better from those of the
        step before, but those of the new ones made from nothing."""
        matrices = jax.vmap(lambda state: mass.matrix(self._system, state))(states)

        def exact():
            identity = jnp.broadcast_to(jnp.eye(matrices.shape[1]), matrices.shape)
            return jax.scipy.linalg.solve(matrices, identity, assume_a="pos")

        steps = self._system.matrix_inv_iterations
        if steps:
            inverses = improved_inverses(matrices, states.mass_mx_inv, new, steps)
            inverses = jax.lax.cond(
                new.any(), lambda: _chosen(new, exact(), inverses), lambda: inverses
            )
        else:
            inverses = exact()
        return states.replace(mass_mx=matrices, mass_mx_inv=inverses)

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


_EXACT = 1e-6
"""What an inverse times its matrix may be off the identity by (Frobenius norm): float32 knows no
better, and Newton's next step after 1e-3 is there."""


def improved_inverses(matrices, inverses, known: jax.Array, steps: int) -> jax.Array:
    """Inverses of matrices [n, D, D], by Newton's method from those of nearby matrices.

    Brax makes the same steps (Schulz's), and all of them whether or not they change anything.

    Args:
      matrices: symmetric, positive definite.
      inverses: of matrices near them.
      known: bool [n], which need no inverse.
      steps: how many are made at most.
    """
    identity = jnp.eye(matrices.shape[1])

    def off(inverses):
        rest = identity - matrices @ inverses
        return rest, jnp.sqrt(jnp.square(rest).sum((1, 2)))

    rest, error = off(inverses)
    # Far from the inverse there is a start from which the steps lead to it.
    far = (error > 1)[:, None, None]
    scale = jnp.square(matrices).sum((1, 2))[:, None, None]
    inverses = jnp.where(far, 0.5 * matrices / scale, inverses)

    def step(carry):
        count, inverses, rest, error, _ = carry
        better = inverses + inverses @ rest
        new_rest, new_error = off(better)
        closer = new_error < error
        chosen = closer[:, None, None]
        going = closer & (new_error > _EXACT) & ~known
        return (
            count + 1,
            jnp.where(chosen, better, inverses),
            jnp.where(chosen, new_rest, rest),
            jnp.where(closer, new_error, error),
            going,
        )

    rest, error = off(inverses)
    going = (error > _EXACT) & ~known
    start = (0, inverses, rest, error, going)
    return jax.lax.while_loop(lambda carry: (carry[0] < steps) & carry[-1].any(), step, start)[1]


def _held(state, new: jax.Array) -> _Held:
    """What is held of n of Brax's states."""
    return _Held(state.q, state.qd, state.mass_mx_inv, state.x.pos, state.x.rot, new)


def _chosen(chosen: jax.Array, new, old):
    """Leaves [n, ...] of `new` where `chosen` (bool [n]), else of `old`."""

    def one(x, y):
        return jnp.where(chosen.reshape(-1, *[1] * (x.ndim - 1)), x, y)

    return jax.tree.map(one, new, old)
