"""Merging by task vectors: what training added to a common start, trimmed, chosen and added.

The target is the *base* θ₀, each source a model θ_n trained from it, and τ_n = θ_n - θ₀ its task
vector (Ilharco et al., 2023). For the rest see `transfer.merging`.

Axis letters: P population member, N source; n numbers in a leaf.
"""

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from transfer.leaves import Array, check_key
from transfer.merging import Number, combined, merge_leaves, weighted
from transfer.select import PyTree, Where


def _kept(density: Array, vectors: Array) -> Array:
    """How many of the n numbers of each source a density keeps, int [N]."""
    size = math.prod(vectors.shape[1:])
    # Rounded down as by int(density * n), but for what binary fractions take from it.
    return jnp.floor(density * size + 1e-3).astype(jnp.int32)


def _largest(vectors: Array, counts: Array, *, skip: Array | int = 0) -> Array:
    """Which numbers are among the `counts` largest of their source after the `skip` largest.

    bool [N, ...]; of equally large ones the first come first.
    """
    flat = jnp.abs(vectors).reshape(vectors.shape[0], -1)
    order = jnp.argsort(-flat, axis=1, stable=True)
    rank = jnp.argsort(order, axis=1).reshape(vectors.shape)
    first = jnp.broadcast_to(skip, counts.shape)
    shape = (-1, *(1,) * (vectors.ndim - 1))
    return (rank >= first.reshape(shape)) & (rank < (first + counts).reshape(shape))


def _elected(vectors: Array, weights: Array, normalise: bool) -> Array:
    """TIES's second and third step: the elected sign, and the mean of what agrees with it."""
    scaled = weighted(weights, vectors) * vectors
    sign = jnp.where(scaled.sum(0) >= 0, 1, -1)
    agrees = (jnp.sign(scaled) == sign) & (vectors != 0)
    total = jnp.where(agrees, scaled, 0).sum(0)
    if not normalise:
        return total
    share = jnp.where(agrees, weighted(weights, vectors), 0).sum(0)
    return jnp.where(share == 0, 0, total / jnp.where(share == 0, 1, share))


def _task_arithmetic(base, models, weights, scale, normalise):
    return base + scale * combined(models - base, weights, normalise)


def task_arithmetic(
    target: PyTree,
    sources: Sequence[PyTree],
    *,
    weights: Any = 1.0,
    scale: Any = 1.0,
    normalise: bool = False,
    population: bool = False,
    where: Where = None,
) -> PyTree:
    """θ₀ + λ Σ w_n τ_n (Ilharco et al., 2023, "Editing Models with Task Arithmetic", section 2).

    A negative weight unlearns a task.

    Args:
      target: θ₀, the model that the sources were trained from.
      sources: N models θ_n.
      weights: w_n, a scalar or [N].
      scale: λ, a scalar.
      normalise: whether the sum is divided by Σ w_n, as mergekit's `normalize`.
      population: whether leaves are stacked on an axis P.
      where: the leaves to merge.

    Raises:
      ValueError: as `transfer.fraction`, or not one weight for each source.

    >>> models = [{"w": jnp.array([2.0, 1.0])}, {"w": jnp.array([1.0, 5.0])}]
    >>> task_arithmetic({"w": jnp.ones(2)}, models, weights=[1.0, 0.5])
    {'w': Array([2., 3.], dtype=float32)}
    """

    return merge_leaves(
        "task_arithmetic",
        _task_arithmetic,
        target,
        sources,
        where,
        population,
        settings=(("normalise", normalise),),
        weights=Number(weights, each=True, low=None, high=None),
        scale=Number(scale, low=None, high=None),
    )


def _ties(base, models, density, weights, scale, normalise):
    vectors = models - base
    trimmed = jnp.where(_largest(vectors, _kept(density, vectors)), vectors, 0)
    return base + scale * _elected(trimmed, weights, normalise)


def ties(
    target: PyTree,
    sources: Sequence[PyTree],
    *,
    density: Any,
    weights: Any = 1.0,
    scale: Any = 1.0,
    normalise: bool = True,
    population: bool = False,
    where: Where = None,
) -> PyTree:
    """Trim, elect sign and merge (Yadav et al., 2023, "TIES-Merging", algorithm 1).

    τ̂_n keeps the ⌊density · n⌋ largest magnitudes of τ_n; γ = sgn(Σ w_n τ̂_n), where 0 counts as
    positive; the merged vector is the weighted mean of those τ̂_n, number by number, that have the
    sign γ and are not 0; and the result θ₀ + λ times it. The paper trims whole models; this trims
    each leaf, as mergekit does.

    Args:
      target: θ₀, the model that the sources were trained from.
      sources: N models θ_n.
      density: share of each τ_n that is kept, in [0, 1]; a scalar or [N].
      weights: w_n, a scalar or [N].
      scale: λ, a scalar.
      normalise: a mean, or with `False` the sum.
      population: whether leaves are stacked on an axis P.
      where: the leaves to merge.

    Raises:
      ValueError: as `transfer.fraction`, or not one number for each source.

    >>> base = {"w": jnp.zeros(3)}
    >>> models = [{"w": jnp.array([4.0, -3.0, 1.0])}, {"w": jnp.array([2.0, 5.0, 0.5])}]
    >>> ties(base, models, density=0.7)
    {'w': Array([3., 5., 0.], dtype=float32)}
    """

    return merge_leaves(
        "ties",
        _ties,
        target,
        sources,
        where,
        population,
        settings=(("normalise", normalise),),
        density=Number(density, each=True),
        weights=Number(weights, each=True, low=None, high=None),
        scale=Number(scale, low=None, high=None),
    )


def _dare(base, models, uniform, density, weights, scale, elect_sign, normalise):
    vectors = models - base
    share = weighted(density, vectors)
    kept = jnp.where(uniform < share, vectors / jnp.where(share == 0, 1, share), 0)
    merged = (_elected if elect_sign else combined)(kept, weights, normalise)
    return base + scale * merged


def dare(
    target: PyTree,
    sources: Sequence[PyTree],
    *,
    density: Any,
    key: jax.Array,
    weights: Any = 1.0,
    scale: Any = 1.0,
    elect_sign: bool = False,
    normalise: bool = False,
    population: bool = False,
    where: Where = None,
) -> PyTree:
    """Drop and rescale (Yu et al., 2024, "Language Models are Super Mario", section 3.2).

    m ~ Bernoulli(density), number by number; τ̂_n = m ⊙ τ_n / density; then task arithmetic, or
    with `elect_sign` the second and third step of `ties` (mergekit's `dare_linear` and
    `dare_ties`). The draw of a leaf depends on the key and the leaf's path alone.

    Args:
      target: θ₀, the model that the sources were trained from.
      sources: N models θ_n.
      density: 1 - p of the paper, share of each τ_n that is kept on average, in [0, 1]; a scalar
        or [N].
      key: one key, or [P] for a population.
      weights: w_n, a scalar or [N].
      scale: λ, a scalar.
      elect_sign: whether signs are elected as by TIES.
      normalise: whether the sum is divided by the weights' sum.
      population: whether leaves are stacked on an axis P.
      where: the leaves to merge.

    Raises:
      ValueError: as `transfer.fraction`, or not one number for each source.

    >>> dare({"w": jnp.zeros(4)}, [{"w": jnp.ones(4)}], density=0.5, key=jax.random.key(4))
    {'w': Array([0., 2., 2., 0.], dtype=float32)}
    """

    return merge_leaves(
        "dare",
        _dare,
        target,
        sources,
        where,
        population,
        settings=(("elect_sign", elect_sign), ("normalise", normalise)),
        key=check_key(key),
        density=Number(density, each=True),
        weights=Number(weights, each=True, low=None, high=None),
        scale=Number(scale, low=None, high=None),
    )


def _breadcrumbs(base, models, density, outliers, weights, scale, elect_sign, normalise):
    vectors = models - base
    kept = _kept(density, vectors)
    size = math.prod(vectors.shape[1:])
    largest = jnp.minimum(_kept(outliers, vectors), size - kept)
    between = _largest(vectors, kept, skip=largest)
    merge = _elected if elect_sign else combined
    return base + scale * merge(jnp.where(between, vectors, 0), weights, normalise)


def breadcrumbs(
    target: PyTree,
    sources: Sequence[PyTree],
    *,
    density: Any,
    outliers: Any,
    weights: Any = 1.0,
    scale: Any = 1.0,
    elect_sign: bool = False,
    normalise: bool = False,
    population: bool = False,
    where: Where = None,
) -> PyTree:
    """Task vectors without their largest and smallest numbers (Davari and Belilovsky, 2024).

    "Model Breadcrumbs", section 3.1: leaf by leaf τ̂_n leaves out the ⌊outliers · n⌋ largest
    magnitudes (fewer where not enough would remain), keeps the ⌊density · n⌋ next, and drops the
    rest; θ₀ + λ Σ w_n τ̂_n.

    Args:
      target: θ₀, the model that the sources were trained from.
      sources: N models θ_n.
      density: share of each τ_n that is kept, in [0, 1]; a scalar or [N].
      outliers: share of the largest that is left out, mergekit's `gamma`; a scalar or [N].
      weights: w_n, a scalar or [N].
      scale: λ, a scalar.
      elect_sign: whether signs are elected as by TIES (mergekit's `breadcrumbs_ties`).
      normalise: whether the sum is divided by the weights' sum.
      population: whether leaves are stacked on an axis P.
      where: the leaves to merge.

    Raises:
      ValueError: as `transfer.fraction`, or not one number for each source.

    >>> breadcrumbs({"w": jnp.zeros(4)}, [{"w": jnp.array([9.0, 2.0, 1.0, 3.0])}],
    ...             density=0.5, outliers=0.25)
    {'w': Array([0., 2., 0., 3.], dtype=float32)}
    """

    return merge_leaves(
        "breadcrumbs",
        _breadcrumbs,
        target,
        sources,
        where,
        population,
        settings=(("elect_sign", elect_sign), ("normalise", normalise)),
        density=Number(density, each=True),
        outliers=Number(outliers, each=True),
        weights=Number(weights, each=True, low=None, high=None),
        scale=Number(scale, low=None, high=None),
    )
