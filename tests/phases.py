"""Phases of random actions, for test_brax.py and the process that it starts."""

import functools

import jax
import jax.numpy as jnp
import numpy as np


@functools.cache
def phase_of(env, tasks, ticks):
    """A jitted phase of random actions by all P * K slots: first time steps, then T of them."""

    @jax.jit
    def phase(key):
        slots = jnp.arange(env.members * tasks).reshape(env.members, tasks)
        keys = jax.random.split(key, slots.shape)
        state, start = jax.vmap(jax.vmap(env.reset))(slots, keys)
        shape = (ticks, env.members, tasks, env.action_size)
        actions = jax.random.uniform(key, shape, minval=-1, maxval=1)
        return start, jax.lax.scan(jax.vmap(jax.vmap(env.step)), state, actions)[1]

    def run(seed):
        result = jax.tree.map(np.asarray, phase(jax.random.key(seed)))
        env.check()
        return result

    run.phase = phase
    return run
