"""Operations that make a new tree from a target and a source.

Every operation is a pure function ``operation(target, source, *, ..., where=None)``: ``target`` is
the tree to change (usually freshly initialised), ``source`` the tree that knowledge comes from, and
``where`` selects leaves of the target: a mask, a pattern, several patterns, or ``None`` for all.

* The result has the target's structure, shapes and dtypes. Leaves outside ``where`` are the very
  objects of the target. Arguments are never changed.
* Leaves of the source are found by path, so it may have another structure, lack what is not
  needed, or be a flat ``{path: array}``.
* Nothing broadcasts. Leaves of different shape are an error that names path and both shapes.
* Arithmetic runs in float32 at least, whatever the dtype, and is rounded once to the target's.
* All of it works under ``jit``, ``vmap`` and ``grad``; only ``where``, axes and indices are static.

A *population* is a tree whose leaves are stacked on a leading axis P. Numbers such as ``omega`` are
scalars or one value per member [P]; axes are counted from the end so that they mean the same for
one tree and for a population. A key is one key, or [P] of them for a population.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from transfer.leaves import (
    Array,
    Indices,
    axis_number,
    cast,
    check_shape,
    draw,
    find,
    find_initializer,
    numeric,
    per_member,
    positions,
    same_but,
    wide,
)
from transfer.select import PyTree, Where, flatten, selected, unflatten


def _change(target: PyTree, where: Where, leaf_operation: Callable[[str, Array], Array]) -> PyTree:
    """The target with ``leaf_operation(path, leaf)`` in place of each selected leaf."""
    leaves = flatten(target)
    chosen = selected(target, where)
    return unflatten(
        target,
        {path: leaf_operation(path, leaf) for path, leaf in leaves.items() if path in chosen},
    )


def _mix(
    target: PyTree,
    source: PyTree,
    where: Where,
    operation: str,
    formula: Callable[[str, Array, Array], Array],
) -> PyTree:
    """An arithmetic operation on pairs of equal shape, in float32 at least."""
    sources = flatten(source)

    def leaf_operation(path, leaf):
        other = find(sources, path)
        numeric(path, operation, leaf, other)
        check_shape(path, leaf, other)
        return cast(path, formula(path, wide(leaf), wide(other)), leaf)

    return _change(target, where, leaf_operation)


def keep(target: PyTree, *, where: Where = None) -> PyTree:
    """The target as it is: where it is freshly initialised, this is random initialisation.

    >>> keep({"w": jnp.zeros(2)})
    {'w': Array([0., 0.], dtype=float32)}
    """
    selected(target, where)
    return target


def copy(target: PyTree, source: PyTree, *, where: Where = None) -> PyTree:
    """The source's leaves in place of the target's: full transfer.

    Raises:
        ValueError: a leaf is missing in the source or has another shape.

    >>> copy({"w": jnp.zeros(2), "b": jnp.zeros(1)}, {"w": jnp.ones(2)}, where="w")
    {'b': Array([0.], dtype=float32), 'w': Array([1., 1.], dtype=float32)}
    """
    sources = flatten(source)

    def leaf_operation(path, leaf):
        other = find(sources, path)
        check_shape(path, leaf, other)
        return cast(path, other, leaf)

    return _change(target, where, leaf_operation)


def fraction(target: PyTree, source: PyTree, *, omega: Any, where: Where = None) -> PyTree:
    """Fractional transfer, W_T + ω·W_S (thesis §3.2.2, equation 19).

    Args:
        target: tree of W_T, freshly initialised.
        source: tree of W_S, trained.
        omega: ω, a scalar or one value per member [P]; traced or not.
        where: the leaves to change.

    Raises:
        ValueError: a leaf is missing in the source, has another shape, or is not floating point.

    >>> fraction({"w": jnp.ones(2)}, {"w": jnp.array([1.0, 2.0])}, omega=0.5)
    {'w': Array([1.5, 2. ], dtype=float32)}
    """

    def formula(path, mine, theirs):
        return mine + per_member(path, "omega", omega, mine) * theirs

    return _mix(target, source, where, "fraction", formula)


def interpolate(target: PyTree, source: PyTree, *, weight: Any, where: Where = None) -> PyTree:
    """(1 - weight)·target + weight·source: the target at 0, the source at 1.

    ``weight`` is a scalar or one value per member [P]. Repeated with a small weight this is the
    moving average of target networks.

    >>> interpolate({"w": jnp.zeros(2)}, {"w": jnp.array([1.0, 2.0])}, weight=0.25)
    {'w': Array([0.25, 0.5 ], dtype=float32)}
    """

    def formula(path, mine, theirs):
        share = per_member(path, "weight", weight, mine)
        return (1 - share) * mine + share * theirs

    return _mix(target, source, where, "interpolate", formula)


def shrink_perturb(
    target: PyTree,
    source: PyTree,
    *,
    shrink: Any,
    noise: Any,
    key: jax.Array,
    where: Where = None,
) -> PyTree:
    """shrink·source + noise·N(0, 1): a warm start that can still learn (Ash and Adams, 2020).

    ``shrink`` and ``noise`` are scalars or one value per member [P]. The draw of a leaf depends on
    the key and the leaf's path alone.

    >>> shrink_perturb({"w": jnp.ones(2)}, {"w": jnp.array([1.0, 2.0])}, shrink=0.5, noise=0.0,
    ...                key=jax.random.key(0))
    {'w': Array([0.5, 1. ], dtype=float32)}
    """

    def formula(path, mine, theirs):
        sample = draw(jax.random.normal, path, key, mine.shape, mine.dtype)
        kept = per_member(path, "shrink", shrink, mine) * theirs
        return kept + per_member(path, "noise", noise, mine) * sample

    return _mix(target, source, where, "shrink_perturb", formula)


def reinitialise(
    target: PyTree,
    *,
    initializer: str | dict[str, Any] | Callable,
    key: jax.Array,
    where: Where = None,
) -> PyTree:
    """Freshly drawn leaves. The draw of a leaf depends on the key and the leaf's path alone.

    Args:
        target: any tree.
        initializer: ``initializer(key, shape, dtype) -> array``, as in ``jax.nn.initializers``;
            or the name of one (a key of ``INITIALIZERS``); or ``{"name": ..., **arguments}``.
        key: one key; or [P] of them for a population, whose members are drawn one by one.
        where: the leaves to draw.

    Raises:
        ValueError: the name is unknown, or a leaf has too few axes for the initializer.

    >>> reinitialise({"w": jnp.ones(2), "b": jnp.ones(1)}, initializer="zeros",
    ...              key=jax.random.key(0), where="w")
    {'b': Array([1.], dtype=float32), 'w': Array([0., 0.], dtype=float32)}
    """
    draw_one = find_initializer(initializer)

    def leaf_operation(path, leaf):
        try:
            return cast(path, draw(draw_one, path, key, leaf.shape, leaf.dtype), leaf)
        except ValueError as error:
            raise ValueError(
                f"{path}: initializer {initializer!r} cannot draw shape {leaf.shape}: {error}"
            ) from error

    return _change(target, where, leaf_operation)


def take(
    target: PyTree,
    source: PyTree,
    *,
    axis: int | str,
    indices: Indices,
    where: Where = None,
) -> PyTree:
    """Rows or columns of the source as whole leaves of a smaller target.

    Args:
        target: the tree whose leaves are replaced.
        source: leaves at least as large along ``axis``.
        axis: ``"input"`` (rows of a kernel, -2), ``"output"`` (columns, -1), or a number.
        indices: positions along the axis of the source: ``"0:30"``, a slice, or integers.
        where: the leaves to change.

    Raises:
        ValueError: what is taken has not the shape of the target's leaf.

    >>> source = {"w": jnp.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])}
    >>> take({"w": jnp.zeros((2, 2))}, source, axis="input", indices=[2, 0])
    {'w': Array([[5., 6.],
           [1., 2.]], dtype=float32)}
    """
    sources = flatten(source)

    def leaf_operation(path, leaf):
        other = find(sources, path)
        number = axis_number(path, axis, other)
        part = jnp.take(other, positions(path, indices, other.shape[number]), axis=number)
        check_shape(path, leaf, part)
        return cast(path, part, leaf)

    return _change(target, where, leaf_operation)


def splice(
    target: PyTree,
    source: PyTree,
    *,
    axis: int | str,
    indices: Indices,
    source_indices: Indices | None = None,
    where: Where = None,
) -> PyTree:
    """Rows or columns of the source put into the target, the rest of the target as it was.

    So a kernel on [features, action] takes over the rows of the features both tasks share and
    keeps its own rows for the actions.

    Args:
        target: the tree to change.
        source: leaves that may differ in size along ``axis`` only.
        axis: ``"input"`` (rows of a kernel, -2), ``"output"`` (columns, -1), or a number.
        indices: positions in the target: ``"0:30"``, a slice, or integers.
        source_indices: as many positions in the source; by default the same.
        where: the leaves to change.

    Raises:
        ValueError: positions that do not exist, repeat, or do not pair up.

    >>> source = {"w": jnp.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])}
    >>> splice({"w": jnp.zeros((2, 2))}, source, axis="input", indices="0:1")
    {'w': Array([[1., 2.],
           [0., 0.]], dtype=float32)}
    """
    sources = flatten(source)

    def leaf_operation(path, leaf):
        other = find(sources, path)
        number = axis_number(path, axis, leaf)
        same_but(path, number, leaf, other)
        to = positions(path, indices, leaf.shape[number])
        chosen = indices if source_indices is None else source_indices
        start = positions(path, chosen, other.shape[number])
        if len(to) != len(start):
            raise ValueError(
                f"{path}: {len(to)} positions of the target, {len(start)} of the source."
            )
        place = (slice(None),) * number
        part = cast(path, other, leaf)[(*place, start)]
        return jnp.asarray(leaf).at[(*place, to)].set(part)

    return _change(target, where, leaf_operation)


def pad(
    target: PyTree,
    source: PyTree,
    *,
    axis: int | str,
    fill: float | None = None,
    groups: int = 1,
    where: Where = None,
) -> PyTree:
    """A source with fewer actions in a target with more: the source first, then the filling.

    Args:
        target: the larger tree.
        source: leaves smaller along ``axis``, equal in all others.
        axis: ``"input"`` (-2), ``"output"`` (-1), or a number.
        fill: the value of what is left; ``None`` leaves the target's own values there.
        groups: the number of equal blocks along the axis that are padded one by one: 2 for a
            layer whose outputs are A means followed by A standard deviations.
        where: the leaves to change.

    Raises:
        ValueError: the source is larger, differs in another axis, or ``groups`` does not divide.

    >>> pad({"b": jnp.zeros(6)}, {"b": jnp.array([1.0, 2.0, 3.0, 4.0])}, axis=-1, groups=2)
    {'b': Array([1., 2., 0., 3., 4., 0.], dtype=float32)}
    """
    return _resize(target, source, axis, fill, groups, where, larger="target")


def crop(
    target: PyTree,
    source: PyTree,
    *,
    axis: int | str,
    groups: int = 1,
    where: Where = None,
) -> PyTree:
    """A source with more actions in a target with fewer: the first ones of the source.

    Arguments and errors as for :func:`pad`, the other way round.

    >>> crop({"b": jnp.zeros(2)}, {"b": jnp.array([1.0, 2.0, 3.0, 4.0])}, axis=-1, groups=2)
    {'b': Array([1., 3.], dtype=float32)}
    """
    return _resize(target, source, axis, None, groups, where, larger="source")


def _resize(target, source, axis, fill, groups, where, *, larger):
    """The part that target and source share, group by group; ``larger`` is the larger of them."""
    sources = flatten(source)

    def leaf_operation(path, leaf):
        other = find(sources, path)
        number = axis_number(path, axis, leaf)
        same_but(path, number, leaf, other)
        sizes = {"target": leaf.shape[number], "source": other.shape[number]}
        if sizes[larger] < max(sizes.values()):
            raise ValueError(
                f"{path}: along axis {number} the target has {sizes['target']} and the source "
                f"{sizes['source']}; use {'crop' if larger == 'target' else 'pad'}."
            )
        if groups < 1 or any(size % groups for size in sizes.values()):
            raise ValueError(
                f"{path}: {groups} groups do not divide the sizes {sizes['target']} and "
                f"{sizes['source']} of axis {number}."
            )
        shared = min(sizes.values()) // groups
        split = lambda x: x.reshape(*x.shape[:number], groups, -1, *x.shape[number + 1 :])  # noqa: E731
        place = (slice(None),) * (number + 1) + (slice(shared),)
        base = jnp.asarray(leaf) if fill is None else jnp.full(leaf.shape, fill, leaf.dtype)
        part = split(cast(path, jnp.asarray(other), leaf))[place]
        return split(base).at[place].set(part).reshape(leaf.shape)

    return _change(target, where, leaf_operation)


def average(
    target: PyTree,
    sources: Sequence[PyTree],
    *,
    weights: Any = None,
    where: Where = None,
) -> PyTree:
    """The weighted mean of several sources in place of the target's leaves.

    Args:
        target: the tree to change.
        sources: N trees.
        weights: [N], divided by their sum; equal by default. Traced or not.
        where: the leaves to change.

    Raises:
        ValueError: no sources, or not one weight for each.

    >>> average({"w": jnp.zeros(1)}, [{"w": jnp.ones(1)}, {"w": 4 * jnp.ones(1)}], weights=[2, 1])
    {'w': Array([2.], dtype=float32)}
    """
    flat = [flatten(source) for source in sources]
    if not flat:
        raise ValueError("average needs at least one source, got none.")
    weights = jnp.ones(len(flat)) if weights is None else jnp.asarray(weights, jnp.float32)
    if weights.shape != (len(flat),):
        raise ValueError(f"Got weights of shape {weights.shape} for {len(flat)} sources.")
    shares = weights / weights.sum()

    def leaf_operation(path, leaf):
        others = [find(source, path) for source in flat]
        numeric(path, "average", leaf, *others)
        for other in others:
            check_shape(path, leaf, other)
        total = sum(share * wide(other) for share, other in zip(shares, others, strict=True))
        return cast(path, total, leaf)

    return _change(target, where, leaf_operation)
