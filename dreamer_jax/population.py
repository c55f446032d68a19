"""Populations: the agent's functions over a leading axis P of members.

Axis letters: P population member, B batch, L sequence length.
"""

import functools

import jax
import jax.numpy as jnp

from dreamer_jax.agent import Agent
from dreamer_jax.learning import AgentState
from dreamer_jax.records import Records


def map_members(function, mapping: str, chunk: int = 1):
    """Maps a function of one member over a leading axis P of all its arguments.

    Args:
      function: of trees of one member.
      mapping: "vmap" runs all members at once, "chunks" `chunk` members after `chunk` members;
        "auto" is "chunks" on the CPU, where batched small products and grouped convolutions are
        slower than a loop, and "vmap" elsewhere.
      chunk: members in a chunk.

    Raises:
      ValueError: unknown mapping.
    """
    if mapping == "auto":
        mapping = "chunks" if jax.default_backend() == "cpu" else "vmap"
    if mapping == "vmap":
        return jax.vmap(function)
    if mapping != "chunks":
        raise ValueError(f"unknown mapping {mapping!r}: choose auto, vmap or chunks")

    def mapped(*trees):
        members = jax.tree.leaves(trees)[0].shape[0]
        if members == 1:
            outputs = function(*jax.tree.map(lambda x: x[0], trees))
            return jax.tree.map(lambda x: x[None], outputs)
        batch_size = chunk if chunk > 1 else None
        return jax.lax.map(lambda arguments: function(*arguments), trees, batch_size=batch_size)

    return mapped


@functools.partial(jax.jit, static_argnums=0, inline=True)
def update_member(agent: Agent, state: AgentState, batch: Records):
    """`agent.update`, whose tracing takes a second: once for whatever asks with the same shapes."""
    return agent.update(state, batch)


@functools.partial(jax.jit, static_argnames=("agent", "mapping", "chunk"), donate_argnums=(1, 2))
def update_members(
    agent: Agent, state: AgentState, sums, batch: Records, *, mapping: str, chunk: int
):
    """One update of every member.

    Args:
      agent: the agent's functions.
      state: leaves [P, ...]; its memory is reused.
      sums: running sums of the metrics, [P] each; its memory is reused.
      batch: leaves [P, B, L, ...].
      mapping, chunk: see `map_members`.

    Returns:
      The new state, the new sums, and the model's loss of this update, [P].
    """
    update = functools.partial(update_member, agent)
    state, metrics = map_members(update, mapping, chunk)(state, batch)
    sums = jax.tree.map(jnp.add, sums, metrics)
    return state, sums, metrics["model_loss"]


@functools.partial(jax.jit, static_argnames="agent")
def init_members(agent: Agent, seeds: jax.Array) -> AgentState:
    """Fresh agents of the given seeds: int32 [P] -> leaves [P, ...]."""
    return jax.vmap(agent.init)(seeds)


def zero_sums(agent: Agent, state: AgentState, batch_size: int, length: int) -> dict:
    """Sums of metrics before the first update, [P] each, without running an update."""
    size = agent.config.network.image_size
    shape = (batch_size, length)
    batch = Records(
        image=jax.ShapeDtypeStruct((*shape, size, size, 3), jnp.uint8),
        action=jax.ShapeDtypeStruct((*shape, agent.action_size), jnp.float32),
        reward=jax.ShapeDtypeStruct(shape, jnp.float32),
        first=jax.ShapeDtypeStruct(shape, jnp.bool_),
        terminal=jax.ShapeDtypeStruct(shape, jnp.bool_),
    )
    member = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), state)
    metrics = update_member.eval_shape(agent, member, batch)[1]
    members = state.updates.shape[0]
    return {name: jnp.zeros(members, x.dtype) for name, x in metrics.items()}
