"""Meta-models: a head over the predictions of frozen heads (thesis §3.3.2, equation 20, Figure 9).

N models of one architecture, trained on N source tasks, are stored. A new model reads, beside its
usual input, what each of them predicts from that input, and learns which to trust.

    stored = store([source["reward"] for source in sources], size=4)
    inputs = meta_inputs(apply_head, stored, features)        # [..., M + 4 * outputs]
    reward = apply_meta(params, inputs)

A head is any function `apply_head(params, inputs) -> predictions`, of any library and for any
purpose: reward, value, or dynamics, whose inputs may be a tuple of state and action. The gradient
passes through the frozen heads into their inputs, never into their parameters.

Axis letters: N source task, M latent feature size; O outputs of a head. For a population map these
functions over the leading axis P of the stored models with `jax.vmap`.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from transfer.ltc import NOVEL
from transfer.population import stack
from transfer.select import PyTree

Array = jax.Array
ApplyHead = Callable[[PyTree, Any], Array]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class StoredHeads:
    """Frozen heads of N source tasks: arrays only, to live in an agent's state and checkpoints.

    Attributes:
      params: parameters of one head with leaves [N, ...]; those of the first head again where
        `present` is False.
      present: bool [N], False for places that only pad N to a common size.
    """

    params: PyTree
    present: Array


def store(heads: Sequence[PyTree], *, size: int | None = None) -> StoredHeads:
    """Store the parameters of heads of one architecture.

    Args:
      heads: their parameters, one tree for each source task.
      size: N to pad to, so that targets with different numbers of sources have one shape and
        train as one population; by default the number of heads.

    Raises:
      ValueError: no heads, more than `size`, or heads that differ in structure or shape.

    >>> stored = store([{"w": jnp.ones(2)}, {"w": 2 * jnp.ones(2)}], size=3)
    >>> stored.params["w"], stored.present
    (Array([[1., 1.],
           [2., 2.],
           [1., 1.]], dtype=float32), Array([ True,  True, False], dtype=bool))
    """
    heads = list(heads)
    size = len(heads) if size is None else size
    if not 0 < len(heads) <= size:
        raise ValueError(f"Got {len(heads)} heads to store in {size} places.")
    # Not zeros, at which a head may be undefined: a NaN would pass the mask in the gradient.
    filled = heads + heads[:1] * (size - len(heads))
    return StoredHeads(stack(filled), jnp.arange(size) < len(heads))


def predictions(apply_head: ApplyHead, stored: StoredHeads, inputs: Any) -> Array:
    """What each stored head predicts.

    Args:
      apply_head: `apply_head(params, inputs) -> float [..., O]`.
      stored: N heads.
      inputs: what a head reads, the same for all: features [..., M], or any pytree.

    Returns:
      float [..., N, O], zero for the places that are not present.

    >>> stored = store([{"w": jnp.ones((2, 1))}, {"w": 2 * jnp.ones((2, 1))}], size=3)
    >>> predictions(lambda params, x: x @ params["w"], stored, jnp.array([1.0, 2.0]))
    Array([[3.],
           [6.],
           [0.]], dtype=float32)
    """
    params = jax.lax.stop_gradient(stored.params)
    outputs = jax.vmap(apply_head, in_axes=(0, None), out_axes=-2)(params, inputs)
    return jnp.where(stored.present[:, None], outputs, jnp.zeros_like(outputs))


def meta_inputs(
    apply_head: ApplyHead, stored: StoredHeads, inputs: Any, *, context: Array | None = None
) -> Array:
    """The input of a meta-model: its usual input and the predictions of the stored heads.

    Args:
      apply_head: as in `predictions`.
      stored: N heads.
      inputs: what a stored head reads.
      context: what the meta-model reads beside, float [..., M]; by default `inputs`.

    Returns:
      float [..., M + N * O]: the context first, then head by head.

    >>> stored = store([{"w": jnp.ones((2, 1))}], size=2)
    >>> meta_inputs(lambda params, x: x @ params["w"], stored, jnp.array([1.0, 2.0]))
    Array([1., 2., 3., 0.], dtype=float32)
    """
    context = inputs if context is None else context
    outputs = predictions(apply_head, stored, inputs)
    flat = outputs.reshape(*outputs.shape[:-2], -1)
    return jnp.concatenate([context, flat.astype(context.dtype)], axis=-1)


def switch(labels: Array, stored_predictions: Array, meta_prediction: Array) -> Array:
    """The stored head of a task that is known, the meta-model for one that is novel (§3.3.3).

    Args:
      labels: int [...], the position of the task's head among the stored, or `NOVEL`, as
        `transfer.ltc.classify` says.
      stored_predictions: float [..., N, O] from `predictions`.
      meta_prediction: float [..., O].

    Returns:
      float [..., O].

    >>> switch(jnp.array([1, NOVEL]), jnp.array([[[1.0], [2.0]]] * 2), jnp.array([[9.0], [9.0]]))
    Array([[2.],
           [9.]], dtype=float32)
    """
    place = jnp.clip(labels, 0)[..., None, None]
    known = jnp.take_along_axis(stored_predictions, place, axis=-2)[..., 0, :]
    return jnp.where((labels == NOVEL)[..., None], meta_prediction, known)
