"""Networks that keep learning: periodic resets, and dormant units recycled.

Deep agents lose the ability to fit what is new. `reset_periodically` draws layers anew every
so many updates (Nikishin et al., 2022, "The Primacy Bias in Deep Reinforcement Learning");
`dormant_units` and `recycle` find and restart the units that have gone silent (Sokar et
al., 2023, "The Dormant Neuron Phenomenon in Deep Reinforcement Learning", ReDo);
`transfer.shrink_perturb` is the third (Ash and Adams, 2020). All are pure functions of arrays
under `jit`, `vmap` and inside `scan`.

Axis letters: B batch; U units of a layer.
"""

from typing import Any

import jax.numpy as jnp

from transfer.leaves import axis_number, cast, check_shape, find
from transfer.patterns import match_paths
from transfer.select import PyTree, Where, flatten, mask_of, paths
from transfer.surgery import change
from transfer.values import check_range

Array = Any


def reset_periodically(
    tree: PyTree, fresh: PyTree, *, step: Any, period: int, until: int | None = None, where: Where
) -> PyTree:
    """The tree, with the selected leaves of `fresh` in every `period`-th step.

    Call it with the parameters and with the optimiser's state, whose memory of the leaves (paths
    such as `0/mu/head/kernel`) ought to be reset with them.

    Args:
      tree: parameters, or an optimiser's state.
      fresh: the same tree, freshly initialised.
      step: the number of the update, from 0; may be traced. Step 0 resets nothing.
      period: updates from one reset to the next.
      until: the first step from which nothing is reset any more; by default none.
      where: the leaves to reset, such as the last layers.

    Raises:
      ValueError: a period below 1, or `fresh` lacks a leaf or has it in another shape.

    >>> tree, fresh = {"body": jnp.ones(1), "head": jnp.ones(1)}, {"head": jnp.zeros(1)}
    >>> [reset_periodically(tree, fresh, step=s, period=2, where="head")["head"].item()
    ...  for s in range(4)]
    [1.0, 1.0, 0.0, 1.0]
    """
    if period < 1:
        raise ValueError(f"The period is a number of updates, 1 or more; got {period}.")
    due = (step % period == 0) & (step > 0)
    if until is not None:
        due &= step < until
    others = flatten(fresh)

    def leaf_operation(path, leaf):
        other = find(others, path)
        check_shape(path, leaf, other)
        return jnp.where(due, cast(path, other, leaf), leaf)

    return change(tree, where, leaf_operation)


def dormancy(activations: Array) -> Array:
    """How active each unit of a layer is beside the others (ReDo, equation 1).

    s_i = E|h_i| / mean_k E|h_k|, the expectation over everything but the last axis: 1 is average, 0
    is silent. A layer that is silent altogether has scores of 0.

    Args:
      activations: float [..., U], of a batch; for a convolution [B, height, width, U].

    Returns:
      float32 [U].

    >>> dormancy(jnp.array([[1.0, 0.0, 3.0], [1.0, 0.0, -1.0]]))
    Array([1., 0., 2.], dtype=float32)
    """
    size = jnp.abs(activations.astype(jnp.float32)).mean(axis=tuple(range(activations.ndim - 1)))
    mean = size.mean()
    return jnp.where(mean > 0, size / jnp.where(mean > 0, mean, 1), 0)


def dormant_units(activations: Array, *, threshold: Any = 0.025) -> Array:
    """Which units are τ-dormant: a score of `threshold` or less (ReDo, definition 3.1).

    Args:
      activations: float [..., U], of a batch.
      threshold: τ, 0 or more; 0.025 in the paper's DQN agents.

    Returns:
      bool [U].

    Raises:
      ValueError: a threshold that is negative or not finite (where it is concrete).

    >>> dormant_units(jnp.array([[1.0, 0.0, 3.0], [1.0, 0.0, -1.0]]))
    Array([False,  True, False], dtype=bool)
    """
    check_range("threshold", threshold, low=0.0, high=None)
    return dormancy(activations) <= threshold


def recycle(
    tree: PyTree,
    fresh: PyTree,
    dormant: Array,
    *,
    incoming: Any,
    outgoing: Any,
    incoming_axis: int | str = "output",
    outgoing_axis: int | str = "input",
) -> PyTree:
    """Dormant units restarted: incoming weights drawn anew, outgoing ones zero (ReDo, section 4).

    The network's function changes by no more than the dormant units contributed to it, and the
    units can learn again. To forget their moments do the same to the optimiser's state, with zeros
    for `fresh`, and patterns such as `0/*/hidden/*`.

    Args:
      tree: parameters, or an optimiser's state.
      fresh: the incoming leaves, freshly initialised; other leaves are not read.
      dormant: bool [U], from `dormant_units`; may be traced.
      incoming: pattern or patterns of the layer's own leaves (kernel and bias), with U on
        `incoming_axis`.
      outgoing: pattern or patterns of the kernels that read the units, with U on
        `outgoing_axis`; or a multiple of U, where a convolution's channels are flattened
        (channels last) in between.
      incoming_axis: `"output"` (-1) for kernels [inputs, outputs]; -2 for Equinox and PyTorch.
        A bias has U on its last axis always.
      outgoing_axis: `"input"` (-2) for kernels [inputs, outputs]; -1 for Equinox and PyTorch.

    Raises:
      ValueError: a pattern that matches nothing, a leaf of another size, or a leaf that `fresh`
        lacks.

    >>> tree = {"h": {"w": jnp.ones((2, 2))}, "out": {"w": jnp.ones((2, 1))}}
    >>> fresh = {"h": {"w": jnp.full((2, 2), 5.0)}}
    >>> new = recycle(tree, fresh, jnp.array([False, True]), incoming="h/w", outgoing="out/w")
    >>> new["h"]["w"].tolist(), new["out"]["w"].tolist()
    ([[1.0, 5.0], [1.0, 5.0]], [[1.0], [0.0]])
    """
    dormant = jnp.asarray(dormant)
    if dormant.ndim != 1:
        raise ValueError(
            f"dormant has shape {dormant.shape}; expected one flag for each unit, [U]."
        )
    names, others = paths(tree), flatten(fresh)
    into, out_of = match_paths(names, incoming), match_paths(names, outgoing)
    if both := sorted(into & out_of):
        raise ValueError(f"{', '.join(both)} is incoming and outgoing both.")

    def flags(path, leaf, axis, repeated=False):
        number = axis_number(path, axis if len(leaf.shape) > 1 else -1, leaf)
        count, rest = divmod(leaf.shape[number], dormant.size)
        if rest or (count != 1 and not repeated):
            raise ValueError(
                f"{path}: axis {number} has size {leaf.shape[number]}, and there are "
                f"{dormant.size} units."
            )
        shape = [1] * len(leaf.shape)
        shape[number] = -1
        return jnp.tile(dormant, count).reshape(shape)

    def leaf_operation(path, leaf):
        if path in out_of:
            return jnp.where(flags(path, leaf, outgoing_axis, True), jnp.zeros_like(leaf), leaf)
        other = find(others, path)
        check_shape(path, leaf, other)
        return jnp.where(flags(path, leaf, incoming_axis), cast(path, other, leaf), leaf)

    return change(tree, mask_of(tree, into | out_of), leaf_operation)
