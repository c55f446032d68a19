"""Which leaves of a pytree: '/'-joined paths, glob patterns and masks.

A leaf's *path* is its JAX key path joined by '/': `reward/out/kernel` in nested dictionaries,
`layers/0/weight` in an Equinox module, `0/mu/reward/out/kernel` in the state of an Optax chain.
The box that Flax NNX puts around an array (`nnx.Variable`) is not part of the path, so the same
layer has the same path in linen and in NNX. An array that an NNX module holds in two places (tied
weights) is one leaf, as in `nnx.state`: it has the path of the first place, and what changes it
changes both.

Patterns over paths are described in `transfer.patterns`.

A *mask* is the same pytree with a `bool` in place of every leaf. Selections are static: they
depend on the structure of a tree and never on its values, so they cost nothing under `jit`.

Only arrays are leaves here. Python numbers, strings and functions inside a tree (the activation of
an Equinox module) are settings: they have no path, no mask selects them, no operation moves them.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from transfer.patterns import is_list, match_paths, pattern_list, suggest

PyTree = Any
Mask = Any
Where = Any


def is_array(leaf: Any) -> bool:
    """Whether a leaf counts: anything with a shape and a dtype, tracers and shape structs too."""
    return hasattr(leaf, "shape") and hasattr(leaf, "dtype")


def _is_nnx_variable(node: Any) -> bool:
    # A tree can hold NNX variables only if somebody imported NNX; importing it here would make
    # every user pay for it.
    nnx = sys.modules.get("flax.nnx")
    return nnx is not None and isinstance(node, nnx.Variable)


class Leaves(Mapping[str, Any]):
    """A flat `{path: array}` whose arrays are made when they are asked for, such as a file's.

    Every operation takes one as a source. A subclass has `shapes`, which say what is there
    without making it.
    """

    @property
    def shapes(self) -> Mapping[str, jax.ShapeDtypeStruct]:
        """Shape and dtype of every array, by path."""
        raise NotImplementedError


class _Entry(NamedTuple):
    """A JAX leaf of a tree. `tied`: the same array came before, under this path."""

    path: str
    leaf: Any
    tied: bool = False


def _entries(tree: PyTree) -> list[_Entry]:
    """Every JAX leaf in tree order, those that are not arrays included."""
    boxes, _ = jax.tree_util.tree_flatten_with_path(tree, is_leaf=_is_nnx_variable)
    entries: list[_Entry] = []
    first_of: dict[int, list[_Entry]] = {}
    for key_path, box in boxes:
        path = jax.tree_util.keystr(key_path, simple=True, separator="/")
        if not _is_nnx_variable(box):
            entries.append(_Entry(path, box))
            continue
        if id(box) in first_of:
            entries += [entry._replace(tied=True) for entry in first_of[id(box)]]
            continue
        inner, _ = jax.tree_util.tree_flatten_with_path(box)
        names = [jax.tree_util.keystr(key, simple=True, separator="/") for key, _ in inner]
        first_of[id(box)] = [
            _Entry(path if len(inner) == 1 else f"{path}/{name}", leaf)
            for name, (_, leaf) in zip(names, inner, strict=True)
        ]
        entries += first_of[id(box)]
    return entries


def flatten(tree: PyTree) -> Mapping[str, Any]:
    """Every array of a tree by its path, in tree order.

    The result is itself a valid source for every operation, which looks its leaves up by path:
    rename or drop entries to fit a checkpoint whose names differ.

    Raises:
      ValueError: two leaves have the same path, as in `{"a/b": x, "a": {"b": y}}`.

    >>> flatten({"actor": {"kernel": jnp.ones((2, 3)), "bias": jnp.zeros(3)}}).keys()
    dict_keys(['actor/bias', 'actor/kernel'])
    """
    if isinstance(tree, Leaves):
        return tree
    entries = [entry for entry in _entries(tree) if is_array(entry.leaf) and not entry.tied]
    flat = {entry.path: entry.leaf for entry in entries}
    if len(flat) < len(entries):
        counts = Counter(entry.path for entry in entries)
        twice = sorted(path for path, count in counts.items() if count > 1)
        raise ValueError(
            f"Two leaves of the tree have the same path: {', '.join(twice)}. "
            "Rename a key that holds a '/'."
        )
    return flat


def unflatten(tree: PyTree, leaves: Mapping[str, Any]) -> PyTree:
    """`tree` with the leaves named in `leaves` put in place of its own.

    Tied weights of NNX modules stay tied.

    Raises:
      ValueError: a name in `leaves` is no path of the tree.

    >>> unflatten({"a": jnp.zeros(2), "b": jnp.zeros(2)}, {"b": jnp.ones(2)})
    {'a': Array([0., 0.], dtype=float32), 'b': Array([1., 1.], dtype=float32)}
    """
    entries = _entries(tree)
    names = {entry.path for entry in entries if is_array(entry.leaf)}
    for path in leaves:
        if path not in names:
            raise ValueError(f"The tree has no leaf {path!r}{suggest(path, names)}.")
    return _rebuild(
        tree,
        [
            leaves[entry.path] if is_array(entry.leaf) and entry.path in leaves else entry.leaf
            for entry in entries
        ],
    )


def _rebuild(tree: PyTree, leaves: Sequence[Any]) -> PyTree:
    """The tree with other JAX leaves. What it holds twice, it holds twice again."""
    boxes, outer = jax.tree.flatten(tree, is_leaf=_is_nnx_variable)
    if not any(map(_is_nnx_variable, boxes)):
        return jax.tree.unflatten(outer, leaves)
    remaining, filled = iter(leaves), []
    made: dict[int, Any] = {}
    for box in boxes:
        if not _is_nnx_variable(box):
            filled.append(next(remaining))
            continue
        held, inner = jax.tree.flatten(box)
        new = jax.tree.unflatten(inner, [next(remaining) for _ in held])
        filled.append(made.setdefault(id(box), new))
    return jax.tree.unflatten(outer, filled)


def paths(tree: PyTree) -> tuple[str, ...]:
    """The paths of all arrays of a tree, in tree order.

    >>> paths({"reward": {"out": {"kernel": jnp.ones((4, 1)), "bias": jnp.ones(1)}}, "step": 3})
    ('reward/out/bias', 'reward/out/kernel')
    """
    return tuple(flatten(tree))


def select(tree: PyTree, *patterns: str | Sequence[str], count: int | None = None) -> Mask:
    """A mask of the leaves whose paths match the patterns.

    Args:
      tree: any pytree; of its arrays only the paths are read.
      *patterns: glob patterns, or lists of them, applied in order: a plain one adds leaves, one
        that begins with `!` takes them away. If the first begins with `!`, all leaves are
        the start.
      count: the number of leaves there ought to be.

    Returns:
      The tree with `True` at the selected leaves and `False` at all others.

    Raises:
      ValueError: a pattern matches nothing, or the number of leaves is not `count`.

    >>> tree = {"gru": {"kernel": jnp.ones((2, 2)), "bias": jnp.ones(2)}, "out": jnp.ones(2)}
    >>> select(tree, "**", "!**/bias", count=2)
    {'gru': {'bias': False, 'kernel': True}, 'out': True}
    """
    names = paths(tree)
    chosen = match_paths(names, *patterns)
    if count is not None and len(chosen) != count:
        listed = ", ".join(name for name in names if name in chosen) or "none"
        raise ValueError(
            f"Patterns {', '.join(map(repr, pattern_list(patterns)))} select {len(chosen)} leaves, "
            f"expected {count}: {listed}."
        )
    return mask_of(tree, chosen)


def mask_of(tree: PyTree, chosen: Iterable[str]) -> Mask:
    """The mask that is `True` at exactly the given paths."""
    chosen = frozenset(chosen)
    flags = [is_array(entry.leaf) and entry.path in chosen for entry in _entries(tree)]
    return _rebuild(tree, flags)


def selected(tree: PyTree, where: Where = None) -> frozenset[str]:
    """The paths that `where` names in a tree.

    Args:
      tree: any pytree.
      where: `None` for every leaf, one pattern, a sequence of patterns, or a mask.

    Raises:
      ValueError: a mask whose structure is not the tree's, or a pattern that matches nothing.

    >>> sorted(selected({"a": jnp.ones(1), "b": jnp.ones(1)}, "!a"))
    ['b']
    """
    names = paths(tree)
    if where is None:
        return frozenset(names)
    if isinstance(where, str):
        return match_paths(names, where)
    if is_list(where) and all(isinstance(pattern, str) for pattern in where):
        return match_paths(names, *where)
    same_structure("the mask", where, "the tree", tree)
    entries = _entries(tree)
    flags = jax.tree.leaves(where)
    for entry, flag in zip(entries, flags, strict=True):
        if isinstance(flag, jax.core.Tracer) or not isinstance(flag, bool | np.bool_ | jax.Array):
            raise ValueError(
                f"{entry.path}: a mask holds True or False, known before tracing; got {flag!r}."
            )
    return frozenset(
        entry.path
        for entry, flag in zip(entries, flags, strict=True)
        if is_array(entry.leaf) and bool(flag)
    )


def split(tree: PyTree, chosen: Iterable[str]) -> tuple[PyTree, PyTree]:
    """The tree with only the chosen leaves, and with all others; `None` for what is left out."""
    chosen = frozenset(chosen)
    entries = _entries(tree)
    flags = [is_array(entry.leaf) and entry.path in chosen for entry in entries]
    pairs = list(zip(entries, flags, strict=True))
    first = _rebuild(tree, [entry.leaf if flag else None for entry, flag in pairs])
    return first, _rebuild(tree, [None if flag else entry.leaf for entry, flag in pairs])


def join(choose: Callable[..., Any], parts: Sequence[PyTree]) -> PyTree:
    """`choose` of the leaves of trees from `split`, `None` being a leaf."""
    is_box = lambda node: node is None or _is_nnx_variable(node)  # noqa: E731
    flat = [jax.tree.flatten(part, is_leaf=is_box) for part in parts]
    if len({structure for _, structure in flat}) != 1:
        raise ValueError("The parts have different structures.")
    made: dict[tuple[int, ...], Any] = {}
    boxes = []
    for together in zip(*(boxes for boxes, _ in flat), strict=True):
        whole = jax.tree.map(choose, *together, is_leaf=lambda leaf: leaf is None)
        # What every part holds twice stays one thing.
        key = tuple(map(id, together))
        boxes.append(made.setdefault(key, whole) if _is_nnx_variable(together[0]) else whole)
    return jax.tree.unflatten(flat[0][1], boxes)


def same_structure(name: str, tree: PyTree, other_name: str, other: PyTree) -> None:
    # JAX's hints do not say that structures compare.
    got: Any = jax.tree.structure(tree)
    expected: Any = jax.tree.structure(other)
    if got != expected:
        raise ValueError(
            f"The structure of {name} is not that of {other_name}: got {got}, expected {expected}."
        )


def _combine(operator, first: Mask, *others: Mask) -> Mask:
    for index, other in enumerate(others):
        same_structure(f"mask {index + 2}", other, "mask 1", first)
    return jax.tree.map(lambda *flags: operator(bool(flag) for flag in flags), first, *others)


def union(first: Mask, *others: Mask) -> Mask:
    """Leaves in any of the masks.

    >>> union({"a": True, "b": False}, {"a": False, "b": False})
    {'a': True, 'b': False}
    """
    return _combine(any, first, *others)


def intersection(first: Mask, *others: Mask) -> Mask:
    """Leaves in all of the masks.

    >>> intersection({"a": True, "b": True}, {"a": False, "b": True})
    {'a': False, 'b': True}
    """
    return _combine(all, first, *others)


def complement(mask: Mask, *, tree: PyTree = None) -> Mask:
    """Leaves that are not in the mask.

    Args:
      mask: a mask.
      tree: the tree it belongs to; needed only where a tree holds leaves that are not arrays,
        which belong to no mask and not to its complement either.

    >>> complement({"a": True, "b": False})
    {'a': False, 'b': True}
    """
    opposite = jax.tree.map(lambda flag: not flag, mask)
    return opposite if tree is None else intersection(opposite, select(tree, "**"))


def difference(first: Mask, *others: Mask) -> Mask:
    """Leaves of the first mask that are in none of the others.

    >>> difference({"a": True, "b": True}, {"a": False, "b": True})
    {'a': True, 'b': False}
    """
    return intersection(first, *(complement(other) for other in others))
