"""Phases: a policy and an environment run together for a fixed number of ticks.

Axis letters: P population member, K task, T ticks in a phase (a phase has T + 1 records),
A action. The environment is any object with `reset(slot, key) -> (state, TimeStep)` and
`step(state, action) -> (state, TimeStep)` that is traceable and maps under `jax.vmap`, where a
time step has the fields image, reward, first and terminal; after a terminal tick the next step
resets. It may have `before(slot, key) -> state` too, a state that the next step resets: then a
program holds the environment once, not once for the reset and once for the steps. And it may have
`program`, an object with these methods that compiled programs hold in its place, so that an
environment made after it shares them.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dreamer_jax.agent import MODES, Agent, Mode
from dreamer_jax.freezing import Params
from dreamer_jax.randomness import Purpose, phase_key
from dreamer_jax.records import Records

# What the key of a phase is for, by number of the mode.
_PURPOSES = tuple(Purpose.EVALUATE if mode == "evaluate" else Purpose.COLLECT for mode in MODES)


def rollout(env, policy: Callable, carry, slot: jax.Array, key: jax.Array, ticks: int) -> Records:
    """Runs one simulator, made anew, for a phase.

    Args:
      env: the environment.
      policy: (carry, image, first, key) -> (action [A], carry).
      carry: the policy's memory before the phase.
      slot: int32 [], which simulator.
      key: seeds the simulator and the policy.
      ticks: T.

    Returns:
      Records with leading axis T + 1.
    """
    env_key, policy_key = jax.random.split(key)
    keys = jax.random.split(policy_key, ticks)
    if hasattr(env, "before"):
        return _rollout_of_steps(env, policy, carry, env.before(slot, env_key), keys)
    env_state, start = env.reset(slot, env_key)

    def tick(loop, key):
        env_state, carry, time_step = loop
        action, carry = policy(carry, time_step.image, time_step.first, key)
        env_state, time_step = env.step(env_state, action)
        # A tick that reset ignored its action.
        action = jnp.where(time_step.first, 0.0, action)
        return (env_state, carry, time_step), (time_step, action)

    _, (steps, actions) = jax.lax.scan(tick, (env_state, carry, start), keys)
    steps = jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), start, steps)
    actions = jnp.concatenate([jnp.zeros_like(actions[:1]), actions])
    return Records(steps.image, actions, steps.reward, steps.first, steps.terminal)


def _rollout_of_steps(env, policy: Callable, carry, env_state, keys: jax.Array) -> Records:
    """The same, from a state that the first step resets."""

    def tick(loop, key):
        env_state, carry, action = loop
        env_state, time_step = env.step(env_state, action)
        action = jnp.where(time_step.first, 0.0, action)
        chosen, carry = policy(carry, time_step.image, time_step.first, key)
        return (env_state, carry, chosen), (time_step, action)

    # What is chosen after the last tick is not played.
    keys = jnp.concatenate([keys, keys[-1:]])
    start = (env_state, carry, jnp.zeros(env.action_size))
    _, (steps, actions) = jax.lax.scan(tick, start, keys)
    return Records(steps.image, actions, steps.reward, steps.first, steps.terminal)


def collect(
    agent: Agent,
    env,
    params: Params,
    seeds: jax.Array,
    updates: jax.Array,
    phase: jax.Array,
    *,
    tasks: int,
    ticks: int,
    mode: Mode | jax.Array,
    numbers: jax.Array | None = None,
) -> Records:
    """One phase of every task by every member, all simulators in step.

    The three modes share one compiled program.

    Args:
      agent: the agent's functions.
      env: an environment of P * K slots; slot p * K + k is task k of member p.
      params: leaves [P, ...]; not used by random phases.
      seeds: int32 [P].
      updates: int32 [P], updates so far.
      phase: int32 [], number of the phase.
      tasks: K.
      ticks: T.
      mode: "random" (prefill), "explore" or "evaluate" (the mode, without noise); or its index in
        `MODES`, int32 [].
      numbers: int32 [P], which members of the environment they are; by default 0 to P - 1.

    Returns:
      Records with leading axes [P, K, T + 1].
    """
    number = jnp.int32(MODES.index(mode)) if isinstance(mode, str) else mode
    # A program that this is a part of is one of the environment itself.
    if not isinstance(seeds, jax.core.Tracer):
        env = getattr(env, "program", env)
    return _collect(
        agent, env, params, seeds, updates, phase, number, numbers, tasks=tasks, ticks=ticks
    )


@functools.partial(jax.jit, static_argnames=("agent", "env", "tasks", "ticks"))
def _collect(agent, env, params, seeds, updates, phase, mode, numbers, *, tasks, ticks) -> Records:
    """`collect` of a mode that is known only as it runs."""

    def one(params, seed, updates, task, slot):
        def policy(carry, image, first, key):
            return agent.policy(params, carry, image, first, key, mode, updates)

        key = phase_key(seed, jnp.array(_PURPOSES)[mode], task, phase)
        return rollout(env, policy, agent.initial_carry(), slot, key, ticks)

    members = seeds.shape[0]
    if numbers is None:
        slots = jnp.arange(members * tasks).reshape(members, tasks)
    else:
        slots = numbers[:, None] * tasks + jnp.arange(tasks)
    over_tasks = jax.vmap(one, in_axes=(None, None, None, 0, 0))
    over_members = jax.vmap(over_tasks, in_axes=(0, 0, 0, None, 0))
    return over_members(params, seeds, updates, jnp.arange(tasks), slots)


class Episode(NamedTuple):
    """One episode, or what a phase's end left of it.

    Attributes:
      start: index of its first record.
      length: agent steps.
      score: the return, the undiscounted sum of rewards.
      fell: whether it ended by itself rather than by the phase's end.
    """

    start: int
    length: int
    score: float
    fell: bool


def episodes(records: Records) -> list[Episode]:
    """The episodes of one phase of one simulator (leaves [T + 1, ...]), in order."""
    first = np.flatnonzero(records.first)
    ends = np.append(first[1:], len(records.first))
    return [
        Episode(
            start=int(start),
            length=int(end - start - 1),
            score=float(np.sum(records.reward[start:end], dtype=np.float64)),
            fell=bool(records.terminal[end - 1]),
        )
        for start, end in zip(first, ends, strict=True)
    ]
