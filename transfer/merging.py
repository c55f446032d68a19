"""Merging: several models that were trained from one start, as one (model merging).

The target is that start, the *base* θ₀; each source θ_n is a model trained from it, and
τ_n = θ_n - θ₀ is its task vector (Ilharco et al., 2023). Every operation is a pure function
``operation(target, sources, *, ..., where=None)`` with the rules of :mod:`transfer.surgery`, and
works leaf by leaf, as mergekit does. :func:`slerp` has one source.

Numbers are scalars, or one for each source [N], or trees of these, one for each leaf (see
:func:`transfer.fraction`); all may be traced, so that many merges are one mapped program. Of a
population each member is merged by itself, with numbers [P] and [P, N] where they differ.

Axis letters: P population member, N source; n numbers in a leaf.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from transfer.leaves import (
    Array,
    beside,
    cast,
    check_casting,
    check_key,
    check_shape,
    draw,
    find,
    is_concrete,
    numbers,
    numeric,
    wide,
)
from transfer.select import PyTree, Where, flatten, paths, selected
from transfer.surgery import change


class _Number(NamedTuple):
    """A parameter of a merge: what it is, and its range; ``each`` means one for every source."""

    value: Any
    each: bool = False
    low: float | None = 0.0
    high: float | None = 1.0


def _merge(
    operation: str,
    formula: Callable[..., Array],
    target: PyTree,
    sources: Sequence[PyTree],
    where: Where,
    population: bool,
    key: jax.Array | None = None,
    reads_target: bool = True,
    **given: _Number,
) -> PyTree:
    """``formula(base, models, *numbers)`` of each leaf, in float32 at least.

    ``models`` is [N, ...]; with a key, uniform numbers of its shape come before the numbers.
    """
    flat = [flatten(source) for source in sources]
    if not flat:
        raise ValueError(f"{operation} needs at least one source, got none.")
    names, chosen = paths(target), selected(target, where)
    by_leaf = {
        name: numbers(name, number.value, names, chosen, low=number.low, high=number.high)
        for name, number in given.items()
    }
    if key is not None:
        key = check_key(key)

    def leaf_operation(path, leaf):
        others = [beside(find(source, path), leaf) for source in flat]
        numeric(path, operation, leaf, *others)
        for other in others:
            check_shape(path, leaf, other)
            check_casting(path, other, leaf, "same_kind")
        base = wide(path, leaf if reads_target else others[0])
        # [P, N, ...] for a population, so that members are mapped and sources follow.
        axis = 1 if population else 0
        models = jnp.stack([wide(path, other) for other in others], axis=axis)
        arguments, axes = [base, models], [0, 0]
        if key is not None:
            arguments.append(
                draw(jax.random.uniform, path, key, models.shape, jnp.float32, population)
            )
            axes.append(0)
        for name, number in given.items():
            value, mapped = _shaped(path, name, number, by_leaf[name][path], base, len(flat), axis)
            arguments.append(value)
            axes.append(0 if mapped else None)
        if population:
            return cast(path, jax.vmap(formula, in_axes=tuple(axes))(*arguments), leaf)
        return cast(path, formula(*arguments), leaf)

    return change(target, where, leaf_operation)


def _shaped(path, name, number: _Number, value, base, count: int, members: int):
    """A number as an array [] or [N], with P in front where ``members``, and whether it has P."""
    shape = np.shape(value)
    per_source = (count,) if number.each else ()
    size = base.shape[:1] if members else ()
    if shape == () and number.each:
        return jnp.full(per_source, value), False
    if shape == per_source:
        return jnp.asarray(value), False
    if members and shape == (*size, *per_source):
        return jnp.asarray(value), True
    wanted = f"a scalar or one value for each of {count} sources" if number.each else "a scalar"
    hint = ", with a leading axis P for a population" if members else ""
    if not members and len(shape) == len(per_source) + 1:
        hint = "; for one value per member of a population say population=True"
    raise ValueError(f"{path}: {name} has shape {shape}; expected {wanted}{hint}.")


def average(
    target: PyTree,
    sources: Sequence[PyTree],
    *,
    weights: Any = 1.0,
    normalise: bool = True,
    population: bool = False,
    where: Where = None,
) -> PyTree:
    """Σ w_n θ_n / Σ w_n, the weighted mean ("Model soups", Wortsman et al., 2022, section 2).

    Args:
        target: the tree to change; its values are not read.
        sources: N models θ_n.
        weights: w_n, 0 or more, a scalar or [N].
        normalise: whether the sum is divided by Σ w_n.
        population: whether leaves are stacked on an axis P.
        where: the leaves to change.

    Raises:
        ValueError: as :func:`transfer.fraction`; not one weight for each source, or all of them 0.

    >>> average({"w": jnp.zeros(1)}, [{"w": jnp.ones(1)}, {"w": 4 * jnp.ones(1)}], weights=[2, 1])
    {'w': Array([2.], dtype=float32)}
    """
    for entry in jax.tree.leaves(weights, is_leaf=lambda x: isinstance(x, list | tuple)):
        concrete = all(map(is_concrete, jax.tree.leaves(entry)))
        if normalise and concrete and not isinstance(entry, str) and not np.any(entry):
            raise ValueError("The weights are all 0; expected one of them greater.")

    def formula(base, models, weights):
        return _combined(models, weights, normalise)

    return _merge(
        "average",
        formula,
        target,
        sources,
        where,
        population,
        reads_target=False,
        weights=_Number(weights, each=True, low=0.0, high=None),
    )


def _weighted(weights: Array, vectors: Array) -> Array:
    """Weights [N] shaped to multiply [N, ...]."""
    return weights.reshape(-1, *(1,) * (vectors.ndim - 1)).astype(vectors.dtype)


def _kept(density: Array, vectors: Array) -> Array:
    """How many of the n numbers of each source a density keeps, int [N]."""
    size = math.prod(vectors.shape[1:])
    # Rounded down as by int(density * n), but for what binary fractions take from it.
    return jnp.floor(density * size + 1e-3).astype(jnp.int32)


def _largest(vectors: Array, counts: Array, *, skip: Array | int = 0) -> Array:
    """Which numbers are among the ``counts`` largest of their source after the ``skip`` largest.

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
    scaled = _weighted(weights, vectors) * vectors
    sign = jnp.where(scaled.sum(0) >= 0, 1, -1)
    agrees = (jnp.sign(scaled) == sign) & (vectors != 0)
    total = jnp.where(agrees, scaled, 0).sum(0)
    if not normalise:
        return total
    share = jnp.where(agrees, _weighted(weights, vectors), 0).sum(0)
    return jnp.where(share == 0, 0, total / jnp.where(share == 0, 1, share))


def _combined(vectors: Array, weights: Array, normalise: bool) -> Array:
    """Σ w_n τ_n, divided by Σ w_n where asked."""
    total = (_weighted(weights, vectors) * vectors).sum(0)
    if not normalise:
        return total
    share = weights.sum().astype(vectors.dtype)
    return total / jnp.where(share == 0, 1, share)


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
        normalise: whether the sum is divided by Σ w_n, as mergekit's ``normalize``.
        population: whether leaves are stacked on an axis P.
        where: the leaves to merge.

    Raises:
        ValueError: as :func:`transfer.fraction`, or not one weight for each source.

    >>> models = [{"w": jnp.array([2.0, 1.0])}, {"w": jnp.array([1.0, 5.0])}]
    >>> task_arithmetic({"w": jnp.ones(2)}, models, weights=[1.0, 0.5])
    {'w': Array([2., 3.], dtype=float32)}
    """

    def formula(base, models, weights, scale):
        return base + scale * _combined(models - base, weights, normalise)

    return _merge(
        "task_arithmetic",
        formula,
        target,
        sources,
        where,
        population,
        weights=_Number(weights, each=True, low=None, high=None),
        scale=_Number(scale, low=None, high=None),
    )


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
        normalise: a mean, or with ``False`` the sum.
        population: whether leaves are stacked on an axis P.
        where: the leaves to merge.

    Raises:
        ValueError: as :func:`transfer.fraction`, or not one number for each source.

    >>> base = {"w": jnp.zeros(3)}
    >>> models = [{"w": jnp.array([4.0, -3.0, 1.0])}, {"w": jnp.array([2.0, 5.0, 0.5])}]
    >>> ties(base, models, density=0.7)
    {'w': Array([3., 5., 0.], dtype=float32)}
    """

    def formula(base, models, density, weights, scale):
        vectors = models - base
        trimmed = jnp.where(_largest(vectors, _kept(density, vectors)), vectors, 0)
        return base + scale * _elected(trimmed, weights, normalise)

    return _merge(
        "ties",
        formula,
        target,
        sources,
        where,
        population,
        density=_Number(density, each=True),
        weights=_Number(weights, each=True, low=None, high=None),
        scale=_Number(scale, low=None, high=None),
    )


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
    with ``elect_sign`` the second and third step of :func:`ties` (mergekit's ``dare_linear`` and
    ``dare_ties``). The draw of a leaf depends on the key and the leaf's path alone.

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
        ValueError: as :func:`transfer.fraction`, or not one number for each source.

    >>> dare({"w": jnp.zeros(4)}, [{"w": jnp.ones(4)}], density=0.5, key=jax.random.key(4))
    {'w': Array([0., 2., 2., 0.], dtype=float32)}
    """

    def formula(base, models, uniform, density, weights, scale):
        vectors = models - base
        share = _weighted(density, vectors)
        kept = jnp.where(uniform < share, vectors / jnp.where(share == 0, 1, share), 0)
        merged = (_elected if elect_sign else _combined)(kept, weights, normalise)
        return base + scale * merged

    return _merge(
        "dare",
        formula,
        target,
        sources,
        where,
        population,
        key=check_key(key),
        density=_Number(density, each=True),
        weights=_Number(weights, each=True, low=None, high=None),
        scale=_Number(scale, low=None, high=None),
    )


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
        outliers: share of the largest that is left out, mergekit's ``gamma``; a scalar or [N].
        weights: w_n, a scalar or [N].
        scale: λ, a scalar.
        elect_sign: whether signs are elected as by TIES (mergekit's ``breadcrumbs_ties``).
        normalise: whether the sum is divided by the weights' sum.
        population: whether leaves are stacked on an axis P.
        where: the leaves to merge.

    Raises:
        ValueError: as :func:`transfer.fraction`, or not one number for each source.

    >>> breadcrumbs({"w": jnp.zeros(4)}, [{"w": jnp.array([9.0, 2.0, 1.0, 3.0])}],
    ...             density=0.5, outliers=0.25)
    {'w': Array([0., 2., 0., 3.], dtype=float32)}
    """

    def formula(base, models, density, outliers, weights, scale):
        vectors = models - base
        kept = _kept(density, vectors)
        size = math.prod(vectors.shape[1:])
        largest = jnp.minimum(_kept(outliers, vectors), size - kept)
        between = _largest(vectors, kept, skip=largest)
        merge = _elected if elect_sign else _combined
        return base + scale * merge(jnp.where(between, vectors, 0), weights, normalise)

    return _merge(
        "breadcrumbs",
        formula,
        target,
        sources,
        where,
        population,
        density=_Number(density, each=True),
        outliers=_Number(outliers, each=True),
        weights=_Number(weights, each=True, low=None, high=None),
        scale=_Number(scale, low=None, high=None),
    )


def model_stock(
    target: PyTree,
    sources: Sequence[PyTree],
    *,
    population: bool = False,
    where: Where = None,
) -> PyTree:
    """Between the base and the mean of the models, as far as their angle says (Jang et al., 2024).

    "Model Stock", equation 2 for N models: t = N cos θ / (1 + (N - 1) cos θ) and
    t · mean(θ_n) + (1 - t) · θ₀, where cos θ is the mean cosine between two task vectors, leaf by
    leaf. Two sources or more; orthogonal task vectors (noise) leave the base, equal ones give
    them. A mean cosine below 0 counts as 0.

    Raises:
        ValueError: as :func:`transfer.fraction`, or fewer than two sources.

    >>> base = {"w": jnp.zeros(2)}
    >>> model_stock(base, [{"w": jnp.array([1.0, 0.0])}, {"w": jnp.array([0.0, 1.0])}])
    {'w': Array([0., 0.], dtype=float32)}
    """
    if len(sources) < 2:
        raise ValueError(f"model_stock needs two sources or more, got {len(sources)}.")

    def formula(base, models):
        vectors = models - base
        count = vectors.shape[0]
        flat = vectors.reshape(count, -1)
        lengths = jnp.linalg.norm(flat, axis=1)
        products = jnp.einsum("in,jn->ij", flat, jnp.conj(flat), precision="highest").real
        lengths = lengths[:, None] * lengths
        cosines = products / jnp.where(lengths == 0, 1, lengths)
        pairs = np.triu_indices(count, 1)
        cosine = jnp.clip(cosines[pairs].mean(), 0, 1)
        share = count * cosine / (1 + (count - 1) * cosine)
        return base + share * vectors.mean(0)

    return _merge("model_stock", formula, target, sources, where, population)


def _angle_weights(weight: Array, cosine: Array) -> tuple[Array, Array]:
    """The weights of both ends in slerp; a straight line where the angle is too small to divide."""
    angle = jnp.arccos(jnp.clip(cosine, -1, 1))
    straight = jnp.abs(cosine) > 0.9995
    safe = jnp.where(straight, 1.0, angle)
    first = jnp.where(straight, 1 - weight, jnp.sin((1 - weight) * safe) / jnp.sin(safe))
    return first, jnp.where(straight, weight, jnp.sin(weight * safe) / jnp.sin(safe))


def slerp(
    target: PyTree,
    source: PyTree,
    *,
    weight: Any,
    population: bool = False,
    where: Where = None,
) -> PyTree:
    """Spherical interpolation: the target at 0, the source at 1, along an arc (Shoemake, 1985).

    sin((1 - t) Ω) / sin Ω · θ_T + sin(t Ω) / sin Ω · θ_S, where Ω is the angle between the leaves
    as vectors; (1 - t) θ_T + t θ_S where they are parallel (|cos Ω| > 0.9995, as in mergekit) or
    one of them is zero.

    Args:
        target: the tree at 0.
        source: the tree at 1.
        weight: t in [0, 1], a scalar.
        population: whether leaves are stacked on an axis P.
        where: the leaves to change.

    Raises:
        ValueError: as :func:`transfer.fraction`.

    >>> new = slerp({"w": jnp.array([1.0, 0.0])}, {"w": jnp.array([0.0, 1.0])}, weight=0.5)
    >>> new["w"].round(4)
    Array([0.7071, 0.7071], dtype=float32)
    """

    def formula(base, models, weight):
        other = models[0]
        product = (base * jnp.conj(other)).sum().real
        lengths = jnp.linalg.norm(base) * jnp.linalg.norm(other)
        cosine = jnp.where(lengths == 0, 1.0, product / jnp.where(lengths == 0, 1, lengths))
        first, second = _angle_weights(weight, cosine)
        return (first * base + second * other).astype(base.dtype)

    return _merge("slerp", formula, target, [source], where, population, weight=_Number(weight))


def karcher_mean(
    target: PyTree,
    sources: Sequence[PyTree],
    *,
    weights: Any = 1.0,
    iterations: int = 20,
    population: bool = False,
    where: Where = None,
) -> PyTree:
    """The mean of the models on the sphere: many models' :func:`slerp` (Karcher, 1977).

    Leaf by leaf the sources are brought to length 1; u ← exp_u(Σ w_n log_u(θ_n / |θ_n|)) is
    repeated from their straight mean, where log_u is the tangent at u towards a point, as long as
    the arc, and exp_u its inverse; the result has the weighted mean of the sources' lengths. The
    target gives shape and dtype only.

    Args:
        target: the tree to change.
        sources: N models.
        weights: w_n, 0 or more, a scalar or [N], divided by their sum.
        iterations: how often; 20 are enough for models trained from one start.
        population: whether leaves are stacked on an axis P.
        where: the leaves to merge.

    Raises:
        ValueError: as :func:`transfer.fraction`, or not one weight for each source.

    >>> ends = [{"w": jnp.array([2.0, 0.0])}, {"w": jnp.array([0.0, 4.0])}]
    >>> karcher_mean({"w": jnp.zeros(2)}, ends)["w"].round(4)
    Array([2.1213, 2.1213], dtype=float32)
    """

    def formula(base, models, weights):
        models = models.reshape(models.shape[0], -1)
        total = weights.sum()
        shares = weights / jnp.where(total == 0, 1, total)
        lengths = jnp.linalg.norm(models, axis=1)
        points = models / jnp.where(lengths == 0, 1, lengths)[:, None]

        def unit(vector):
            length = jnp.linalg.norm(vector)
            return vector / jnp.where(length == 0, 1, length)

        def step(_, mean):
            cosines = jnp.clip(points @ mean, -1, 1)
            aside = points - cosines[:, None] * mean
            size = jnp.linalg.norm(aside, axis=1)
            tangent = aside * (jnp.arctan2(size, cosines) / jnp.where(size == 0, 1, size))[:, None]
            move = (shares[:, None] * tangent).sum(0)
            angle = jnp.linalg.norm(move)
            return unit(jnp.cos(angle) * mean + jnp.sinc(angle / jnp.pi) * move)

        mean = jax.lax.fori_loop(0, iterations, step, unit((shares[:, None] * points).sum(0)))
        return ((shares * lengths).sum() * mean).reshape(base.shape)

    return _merge(
        "karcher_mean",
        formula,
        target,
        sources,
        where,
        population,
        reads_target=False,
        weights=_Number(weights, each=True, low=0.0, high=None),
    )
