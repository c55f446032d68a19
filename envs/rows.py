"""Values as rows of 32-bit words, and functions of many rows that can be mapped row by row.

n rows of one batch, W words in a row, P population member, K tasks. What an environment must do
for all of its slots at once, a host callback above all, is written as a function of rows; mapped
code then hands over its whole batch, and a row may hold the state of any task.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap


def words(*values: jax.Array) -> jax.Array:
    """The bits of scalars and vectors of 32-bit types, joined: int32 [W]."""
    return jnp.concatenate(
        [jax.lax.bitcast_convert_type(jnp.atleast_1d(x), jnp.int32) for x in values]
    )


def key_words(slot: jax.Array, key: jax.Array) -> jax.Array:
    """A slot and the words of a key (typed or raw) as one row: int32 [W].

    Raises:
      ValueError: if they are several slots or keys.
    """
    if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        key = jax.random.key_data(key)
    slot = jnp.asarray(slot, jnp.int32)
    if slot.shape != () or key.ndim != 1:
        raise ValueError(
            f"got slots of shape {slot.shape} and keys of shape {key.shape[:-1]}, expected "
            "one slot and one key: map over several with jax.vmap"
        )
    return words(slot, key)


def action_words(state: Any, action: jax.Array, action_size: int) -> jax.Array:
    """A state's leaves of 32-bit types and an action as one row: int32 [W].

    Raises:
      ValueError: if the action is not of length `action_size`.
    """
    if action.shape != (action_size,):
        raise ValueError(
            f"got an action of shape {action.shape}, expected {(action_size,)}: "
            "map over several simulators with jax.vmap"
        )
    return words(*jax.tree.leaves(state), jnp.asarray(action, jnp.float32))


def members_of_shard(members: int, shards: int) -> int:
    """How many of P members each of several programs plays, the last one perhaps fewer."""
    return -(-members // shards)


def check_slots(slots: np.ndarray, members: int, tasks: int) -> None:
    """Raise a ValueError unless `slots` are some of the P * K, each at most once."""
    count = members * tasks
    if slots.min() < 0 or slots.max() >= count:
        raise ValueError(
            f"got slots {slots.tolist()}, expected 0 to {count - 1} ({members} members "
            f"x {tasks} tasks)"
        )
    if len(set(slots.tolist())) != len(slots):
        raise ValueError(
            f"got slots {slots.tolist()}, of which some are alike: map over slots, so that "
            "every member has its own simulator"
        )


class Layout:
    """How a tree of arrays lies in a row of words.

    Args:
      template: the tree, of arrays or `jax.ShapeDtypeStruct`, of 32-bit types and bool.
    """

    def __init__(self, template: Any):
        self._leaves, self._structure = jax.tree.flatten(template)
        self.size = sum(math.prod(leaf.shape) for leaf in self._leaves)

    def pack(self, tree: Any, size: int | None = None) -> jax.Array:
        """The tree as int32 [size], zeros at the end if `size` is more than it takes."""
        leaves = [x.astype(jnp.int32) if x.dtype == bool else x for x in jax.tree.leaves(tree)]
        row = words(*(x.reshape(-1) for x in leaves))
        return jnp.pad(row, (0, (size or self.size) - self.size))

    def unpack(self, row: jax.Array) -> Any:
        """The tree from a row that `pack` made, int32 [size]."""
        leaves, start = [], 0
        for leaf in self._leaves:
            end = start + math.prod(leaf.shape)
            part = row[start:end].reshape(leaf.shape)
            boolean = leaf.dtype == bool
            leaves.append(part != 0 if boolean else jax.lax.bitcast_convert_type(part, leaf.dtype))
            start = end
        return jax.tree.unflatten(self._structure, leaves)


def mapped_rows(function: Callable[[jax.Array], Any]) -> Callable[[jax.Array], Any]:
    """A function of rows, int32 [n, W] -> leaves [n, ...], as one of a single row.

    However many axes of the row are mapped, `function` is called once, with all rows: so it may
    hold an ordered callback, which JAX refuses to map. Map over the row if anything is mapped.
    """

    @custom_vmap
    def call(row):
        lead = row.shape[:-1]
        # JAX traces what is mapped with no mesh or with an empty one, which is the same; said in
        # one way, so that the jitted functions within are not traced once for each.
        with jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()):
            results = function(row.reshape(math.prod(lead), row.shape[-1]))
        return jax.tree.map(lambda x: x.reshape((*lead, *x.shape[1:])), results)

    @call.def_vmap
    def _(axis_size, in_batched, row):
        results = call(row)
        return results, jax.tree.map(lambda _: True, results)

    return call


def apply_by_group(
    functions: Sequence[Callable], groups: Sequence[int], members: int, slots: jax.Array, rows: Any
) -> Any:
    """Apply to each row the function of its task's group, in one call for all rows of a group.

    If the rows are those of all P * K slots, each function gets its own rows and no others,
    whatever their order. Of fewer slots, which task a row plays is known only as it runs: then
    the rows are done one after another.

    Args:
      functions: one for each group, leaves [m, ...] -> leaves [m, ...], all of the same types.
      groups: K, the group of each task.
      members: P, of those that one program plays.
      slots: int32 [n], member * K + task.
      rows: leaves [n, ...].

    Returns:
      Leaves [n, ...], in the order of the rows.
    """
    tasks = len(groups)
    if len(functions) == 1:
        return functions[0](rows)
    if len(slots) == members * tasks:
        by_slot = jnp.argsort(slots).reshape(members, tasks)
        chosen = [
            by_slot[:, [k for k in range(tasks) if groups[k] == group]].reshape(-1)
            for group in range(len(functions))
        ]
        results = [
            function(jax.tree.map(lambda x, index=index: x[index], rows))
            for function, index in zip(functions, chosen, strict=True)
        ]
        back = jnp.argsort(jnp.concatenate(chosen))
        return jax.tree.map(lambda *parts: jnp.concatenate(parts)[back], *results)

    def alone(function):
        return lambda row: jax.tree.map(
            lambda x: x[0], function(jax.tree.map(lambda x: x[None], row))
        )

    def one(slot_and_row):
        slot, row = slot_and_row
        group = jnp.array(groups)[slot % tasks]
        return jax.lax.switch(group, [alone(function) for function in functions], row)

    return jax.lax.map(one, (slots, rows))
