"""Operations that make a new tree from a target and a source.

Every operation is a pure function `operation(target, source, *, ..., where=None)`: `target` is
the tree to change (usually freshly initialised), `source` the tree that knowledge comes from, and
`where` selects leaves of the target: a mask, a pattern, several patterns, or `None` for all.

* The result has the target's structure, shapes, dtypes and sharding. Leaves outside `where` are
  the very objects of the target; the others are JAX arrays. Arguments are never changed.
* What is copied whole is not copied in memory: where dtype and place agree, the result holds the
  source's own array. Arrays never change, so this shows only where one is donated: donating the
  result (`jax.jit(..., donate_argnums=...)`) takes the buffers of the source too, and of the
  target's leaves that were left as they were. Donate `jax.tree.map(jnp.copy, result)` to keep
  both. NumPy arrays, which can change, are always copied.
* Leaves of the source are found by path, so it may have another structure, lack what is not
  needed, or be a flat `{path: array}`.
* Nothing broadcasts. Leaves of different shape are an error that names path and both shapes.
* Arithmetic runs in float32 at least, whatever the dtype, and is rounded once to the target's. A
  dtype that cannot hold the values is an error where they are concrete (`casting`).
* Numbers such as `omega` have a range and are finite, which is checked where they are concrete.
  They may be traced and differentiated. A number may differ between leaves: a mapping
  `{path, branch or pattern: number}`, or a tree such as the target's own.
* All of it works under `jit`, `vmap` and `grad`; only `where`, axes and indices are static.

A *population* is a tree whose leaves are stacked on a leading axis P. With `population=True` each
number may be one value per member [P] and a key may be [P] of them; without it they are scalars and
one key, so that a vector never scales the rows of a matrix by mistake. Axes are counted from the
end, and mean the same for one tree and for a population.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from transfer.leaves import (
    Array,
    Casting,
    Indices,
    axis_number,
    beside,
    cast,
    check_casting,
    check_key,
    check_shape,
    draw,
    find,
    find_initializer,
    numeric,
    positions,
    same_but,
    wide,
    wide_dtype,
)
from transfer.select import PyTree, Where, flatten, paths, selected, unflatten
from transfer.values import numbers, per_member


def change(target: PyTree, where: Where, leaf_operation: Callable[[str, Array], Array]) -> PyTree:
    """The target with `leaf_operation(path, leaf)` in place of each selected leaf."""
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
    formula: Callable[..., Array],
    population: bool,
    **values: tuple[Any, float | None],
) -> PyTree:
    """An arithmetic operation on pairs of equal shape, in float32 at least.

    `formula(path, target, source, *numbers)`; `values` are its numbers by name, each with the
    greatest that is allowed; the least is 0.
    """
    sources, names, chosen = flatten(source), paths(target), selected(target, where)
    by_leaf = {
        name: numbers(name, value, names, chosen, high=high)
        for name, (value, high) in values.items()
    }

    def leaf_operation(path, leaf):
        other = beside(find(sources, path), leaf)
        numeric(path, operation, leaf, other)
        check_shape(path, leaf, other)
        check_casting(path, other, leaf, "same_kind")
        mine = wide(path, leaf)
        amounts = [per_member(path, name, by_leaf[name][path], mine, population) for name in values]
        return cast(path, formula(path, mine, wide(path, other), *amounts), leaf)

    return change(target, where, leaf_operation)


def keep(target: PyTree, *, where: Where = None) -> PyTree:
    """The target as it is: where it is freshly initialised, this is random initialisation.

    >>> keep({"w": jnp.zeros(2)})
    {'w': Array([0., 0.], dtype=float32)}
    """
    selected(target, where)
    return target


def copy(
    target: PyTree,
    source: PyTree,
    *,
    casting: Casting = "same_kind",
    where: Where = None,
) -> PyTree:
    """The source's leaves in place of the target's: full transfer.

    Args:
      target: the tree to change.
      source: the tree that is copied from.
      casting: what a difference of dtype may do, as in NumPy: `"no"` difference at all;
        `"same_kind"` (rounding, but neither a fraction to an integer nor a complex number to
        a real one, nor a value to a dtype that cannot hold it, such as 1e6 to float16);
        `"unsafe"`, anything.
      where: the leaves to change.

    Raises:
      ValueError: a leaf is missing in the source, has another shape, or would lose its values.

    >>> copy({"w": jnp.zeros(2), "b": jnp.zeros(1)}, {"w": jnp.ones(2)}, where="w")
    {'b': Array([0.], dtype=float32), 'w': Array([1., 1.], dtype=float32)}
    """
    sources = flatten(source)

    def leaf_operation(path, leaf):
        other = find(sources, path)
        check_shape(path, leaf, other)
        return cast(path, other, leaf, casting=casting)

    return change(target, where, leaf_operation)


def fraction(
    target: PyTree, source: PyTree, *, omega: Any, population: bool = False, where: Where = None
) -> PyTree:
    """Fractional transfer, W_T + ω·W_S (thesis §3.2.2, equation 19).

    Args:
      target: tree of W_T, freshly initialised.
      source: tree of W_S, trained.
      omega: ω in [0, 1], a scalar; one value per member [P] of a population; or such a number for
        each leaf, as a mapping or tree. Traced or not.
      population: whether the leaves are stacked on an axis P.
      where: the leaves to change.

    Raises:
      ValueError: a leaf is missing in the source, has another shape, or is not floating point;
        or ω is out of range.

    >>> fraction({"w": jnp.ones(2)}, {"w": jnp.array([1.0, 2.0])}, omega=0.5)
    {'w': Array([1.5, 2. ], dtype=float32)}
    """

    def formula(path, mine, theirs, omega):
        return mine + omega * theirs

    return _mix(target, source, where, "fraction", formula, population, omega=(omega, 1.0))


def interpolate(
    target: PyTree, source: PyTree, *, weight: Any, population: bool = False, where: Where = None
) -> PyTree:
    """(1 - weight)·target + weight·source: the target at 0, the source at 1.

    `weight` is in [0, 1], given as `omega` of `fraction`. Repeated with a small weight
    this is the moving average of target networks.

    >>> interpolate({"w": jnp.zeros(2)}, {"w": jnp.array([1.0, 2.0])}, weight=0.25)
    {'w': Array([0.25, 0.5 ], dtype=float32)}
    """

    def formula(path, mine, theirs, weight):
        return (1 - weight) * mine + weight * theirs

    return _mix(target, source, where, "interpolate", formula, population, weight=(weight, 1.0))


def shrink_perturb(
    target: PyTree,
    source: PyTree,
    *,
    shrink: Any,
    noise: Any,
    key: jax.Array,
    population: bool = False,
    where: Where = None,
) -> PyTree:
    """shrink·source + noise·N(0, 1): a warm start that can still learn (Ash and Adams, 2020).

    `shrink` is in [0, 1] and `noise` 0 or more, given as `omega` of `fraction`. The
    draw of a leaf depends on the key and the leaf's path alone.

    >>> shrink_perturb({"w": jnp.ones(2)}, {"w": jnp.array([1.0, 2.0])}, shrink=0.5, noise=0.0,
    ...                key=jax.random.key(0))
    {'w': Array([0.5, 1. ], dtype=float32)}
    """

    def formula(path, mine, theirs, shrink, noise):
        sample = draw(jax.random.normal, path, key, mine.shape, mine.dtype, population)
        return shrink * theirs + noise * sample

    return _mix(
        target,
        source,
        where,
        "shrink_perturb",
        formula,
        population,
        shrink=(shrink, 1.0),
        noise=(noise, None),
    )


def reinitialise(
    target: PyTree,
    *,
    initializer: str | Mapping[str, Any] | Callable,
    key: jax.Array,
    population: bool = False,
    where: Where = None,
) -> PyTree:
    """Freshly drawn leaves. The draw of a leaf depends on the key and the leaf's path alone.

    Args:
      target: any tree.
      initializer: `initializer(key, shape, dtype) -> array`, as in `jax.nn.initializers`;
        or the name of one (a key of `INITIALIZERS`); or `{"name": ..., **arguments}`.
      key: one key; or [P] of them for a population, whose members are drawn one by one.
      population: whether the leaves are stacked on an axis P.
      where: the leaves to draw.

    Raises:
      ValueError: the name is unknown, or a leaf has too few axes for the initializer.

    >>> reinitialise({"w": jnp.ones(2), "b": jnp.ones(1)}, initializer="zeros",
    ...              key=jax.random.key(0), where="w")
    {'b': Array([1.], dtype=float32), 'w': Array([0., 0.], dtype=float32)}
    """
    draw_one, checked = find_initializer(initializer), check_key(key)

    def leaf_operation(path, leaf):
        shape, dtype = leaf.shape, leaf.dtype
        if jnp.issubdtype(dtype, jnp.floating) and jnp.finfo(dtype).bits < 16:
            dtype = wide_dtype(dtype)  # which no initializer draws
        try:
            return cast(path, draw(draw_one, path, checked, shape, dtype, population), leaf)
        except (ValueError, TypeError) as error:
            raise ValueError(
                f"{path}: initializer {initializer!r} cannot draw shape {shape}: {error}"
            ) from error

    return change(target, where, leaf_operation)


def take(
    target: PyTree,
    source: PyTree,
    *,
    axis: int | str,
    indices: Indices,
    casting: Casting = "same_kind",
    where: Where = None,
) -> PyTree:
    """Rows or columns of the source as whole leaves of a smaller target.

    Args:
      target: the tree whose leaves are replaced.
      source: leaves at least as large along `axis`.
      axis: `"input"` (rows of a kernel, -2), `"output"` (columns, -1), or a number.
      indices: positions along the axis of the source: `"0:30"`, a slice, or integers.
      casting: as for `copy`.
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
        place = (slice(None),) * number
        part = other[(*place, positions(path, indices, other.shape[number]))]
        check_shape(path, leaf, part)
        return cast(path, part, leaf, casting=casting)

    return change(target, where, leaf_operation)


def splice(
    target: PyTree,
    source: PyTree,
    *,
    axis: int | str,
    indices: Indices,
    source_indices: Indices | None = None,
    casting: Casting = "same_kind",
    where: Where = None,
) -> PyTree:
    """Rows or columns of the source put into the target, the rest of the target as it was.

    So a kernel on [features, action] takes over the rows of the features both tasks share and
    keeps its own rows for the actions.

    Args:
      target: the tree to change.
      source: leaves that may differ in size along `axis` only.
      axis: `"input"` (rows of a kernel, -2), `"output"` (columns, -1), or a number.
      indices: positions in the target: `"0:30"`, a slice, or integers.
      source_indices: as many positions in the source; by default the same.
      casting: as for `copy`.
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
        part = _converted(path, other[(*place, start)], leaf, casting)
        return cast(path, _values(path, leaf).at[(*place, to)].set(part), leaf)

    return change(target, where, leaf_operation)


def pad(
    target: PyTree,
    source: PyTree,
    *,
    axis: int | str,
    fill: float | None = None,
    groups: int = 1,
    casting: Casting = "same_kind",
    where: Where = None,
) -> PyTree:
    """A source with fewer actions in a target with more: the source first, then the filling.

    Args:
      target: the larger tree.
      source: leaves smaller along `axis`, equal in all others.
      axis: `"input"` (-2), `"output"` (-1), or a number.
      fill: the value of what is left; `None` leaves the target's own values there.
      groups: the number of equal blocks along the axis that are padded one by one: 2 for a
        layer whose outputs are A means followed by A standard deviations.
      casting: as for `copy`.
      where: the leaves to change.

    Raises:
      ValueError: the source is larger, differs in another axis, or `groups` does not divide.

    >>> pad({"b": jnp.zeros(6)}, {"b": jnp.array([1.0, 2.0, 3.0, 4.0])}, axis=-1, groups=2)
    {'b': Array([1., 2., 0., 3., 4., 0.], dtype=float32)}
    """
    return _resize(target, source, axis, fill, groups, casting, where, larger="target")


def crop(
    target: PyTree,
    source: PyTree,
    *,
    axis: int | str,
    groups: int = 1,
    casting: Casting = "same_kind",
    where: Where = None,
) -> PyTree:
    """A source with more actions in a target with fewer: the first ones of the source.

    Arguments and errors as for `pad`, the other way round.

    >>> crop({"b": jnp.zeros(2)}, {"b": jnp.array([1.0, 2.0, 3.0, 4.0])}, axis=-1, groups=2)
    {'b': Array([1., 3.], dtype=float32)}
    """
    return _resize(target, source, axis, None, groups, casting, where, larger="source")


def _values(path: str, leaf: Array) -> jax.Array:
    """A leaf of the target as a JAX array; an error for a shape without values."""
    if isinstance(leaf, jax.ShapeDtypeStruct):
        wide(path, leaf)
    return jnp.asarray(leaf)


def _converted(path: str, part: Array, leaf: Array, casting: str) -> Array:
    """Part of a source in the dtype and on the devices of the target's leaf."""
    check_casting(path, part, leaf, casting)
    return beside(part, leaf).astype(leaf.dtype)


def _resize(target, source, axis, fill, groups, casting, where, *, larger):
    """The part that target and source share, group by group; `larger` is the larger of them."""
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
        part = _converted(path, split(other)[place], leaf, casting)
        # All of a target that is cropped to is overwritten, so it may be a shape without values.
        if larger == "source":
            return cast(path, part.reshape(leaf.shape), leaf)
        filled = fill is not None
        base = jnp.full(leaf.shape, fill, leaf.dtype) if filled else _values(path, leaf)
        return cast(path, split(base).at[place].set(part).reshape(leaf.shape), leaf)

    return change(target, where, leaf_operation)
