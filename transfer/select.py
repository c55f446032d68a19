"""Which leaves of a pytree: '/'-joined paths, glob patterns and masks.

A leaf's *path* is its JAX key path joined by '/': ``reward/out/kernel`` in nested dictionaries,
``layers/0/weight`` in an Equinox module, ``0/mu/reward/out/kernel`` in the state of an Optax chain.
The box that Flax NNX puts around an array (``nnx.Variable``) is not part of the path, so the same
layer has the same path in linen and in NNX.

A *pattern* is a glob over the parts of a path:

====================  ======================================================
``reward/out/*``      ``*`` and ``?`` and ``[ab]`` match inside one part
``dynamics/**``       ``**`` stands for any number of parts, none included
``!dynamics/gru/*``   ``!`` takes leaves away from what came before it
====================  ======================================================

A *mask* is the same pytree with a ``bool`` in place of every leaf. Selections are static: they
depend on the structure of a tree and never on its values, so they cost nothing under ``jit``.

Only arrays are leaves here. Python numbers, strings and functions inside a tree (the activation of
an Equinox module) are settings: they have no path, no mask selects them, no operation moves them.
"""

import difflib
import fnmatch
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import jax

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


def _entries(tree: PyTree) -> list[tuple[str, Any]]:
    """(path, leaf) of every JAX leaf in tree order, those that are not arrays included."""
    boxes, _ = jax.tree_util.tree_flatten_with_path(tree, is_leaf=_is_nnx_variable)
    entries = []
    for key_path, box in boxes:
        path = jax.tree_util.keystr(key_path, simple=True, separator="/")
        if not _is_nnx_variable(box):
            entries.append((path, box))
            continue
        inner, _ = jax.tree_util.tree_flatten_with_path(box)
        for inner_path, leaf in inner:
            name = jax.tree_util.keystr(inner_path, simple=True, separator="/")
            entries.append((path if len(inner) == 1 else f"{path}/{name}", leaf))
    return entries


def flatten(tree: PyTree) -> dict[str, Any]:
    """Every array of a tree by its path, in tree order.

    The result is itself a valid source for every operation, which looks its leaves up by path:
    rename or drop entries to fit a checkpoint whose names differ.

    Raises:
        ValueError: two leaves have the same path, as in ``{"a/b": x, "a": {"b": y}}``.

    >>> flatten({"actor": {"kernel": jnp.ones((2, 3)), "bias": jnp.zeros(3)}}).keys()
    dict_keys(['actor/bias', 'actor/kernel'])
    """
    entries = [(path, leaf) for path, leaf in _entries(tree) if is_array(leaf)]
    flat = dict(entries)
    if len(flat) < len(entries):
        twice = sorted(path for path, n in Counter(path for path, _ in entries).items() if n > 1)
        raise ValueError(
            f"Two leaves of the tree have the same path: {', '.join(twice)}. "
            "Rename a key that holds a '/'."
        )
    return flat


def unflatten(tree: PyTree, leaves: dict[str, Any]) -> PyTree:
    """``tree`` with the leaves named in ``leaves`` put in place of its own.

    Raises:
        ValueError: a name in ``leaves`` is no path of the tree.

    >>> unflatten({"a": jnp.zeros(2), "b": jnp.zeros(2)}, {"b": jnp.ones(2)})
    {'a': Array([0., 0.], dtype=float32), 'b': Array([1., 1.], dtype=float32)}
    """
    names = set(flatten(tree))
    for path in leaves:
        if path not in names:
            raise ValueError(f"The tree has no leaf {path!r}{suggest(path, names)}.")
    new = [
        leaves[path] if is_array(leaf) and path in leaves else leaf for path, leaf in _entries(tree)
    ]
    return jax.tree.unflatten(jax.tree.structure(tree), new)


def paths(tree: PyTree) -> tuple[str, ...]:
    """The paths of all arrays of a tree, in tree order.

    >>> paths({"reward": {"out": {"kernel": jnp.ones((4, 1)), "bias": jnp.ones(1)}}, "step": 3})
    ('reward/out/bias', 'reward/out/kernel')
    """
    return tuple(flatten(tree))


def match(pattern: str, path: str) -> bool:
    """Whether a glob pattern (without ``!``) matches a whole path.

    >>> match("dynamics/**/kernel", "dynamics/prior/out/kernel"), match("*/out", "reward/out/bias")
    (True, False)
    """
    return _match_parts(pattern.split("/"), path.split("/") if path else [])


def _match_parts(pattern: list[str], path: list[str]) -> bool:
    if not pattern:
        return not path
    if pattern[0] == "**":
        return any(_match_parts(pattern[1:], path[skip:]) for skip in range(len(path) + 1))
    if not path or not fnmatch.fnmatchcase(path[0], pattern[0]):
        return False
    return _match_parts(pattern[1:], path[1:])


def suggest(pattern: str, names: Iterable[str]) -> str:
    """Near misses for an error message: leaves, and branches written as ``branch/**``."""
    names = list(names)
    branches = {
        "/".join(name.split("/")[:depth]) + "/**"
        for name in names
        for depth in range(1, name.count("/") + 1)
    }
    near = difflib.get_close_matches(pattern.lstrip("!"), [*names, *sorted(branches)], n=4)
    if near:
        return f"; did you mean {', '.join(near)}?"
    listed = ", ".join(names[:8]) + (f", ... ({len(names)} in all)" if len(names) > 8 else "")
    return f"; the leaves are {listed or 'none'}"


def match_paths(names: Sequence[str], *patterns: str, optional: bool = False) -> frozenset[str]:
    """The names among ``names`` that the patterns select, taken in order.

    Raises:
        ValueError: a pattern matches no name at all, unless ``optional``; the message lists near
            misses.
    """
    if not patterns:
        raise ValueError("No pattern was given; '**' selects every leaf.")
    chosen: set[str] = set(names) if patterns[0].startswith("!") else set()
    for pattern in patterns:
        found = {name for name in names if match(pattern.removeprefix("!"), name)}
        if not found and not optional:
            raise ValueError(f"Pattern {pattern!r} matches no leaf{suggest(pattern, names)}.")
        chosen = chosen - found if pattern.startswith("!") else chosen | found
    return frozenset(chosen)


def select(tree: PyTree, *patterns: str, count: int | None = None) -> Mask:
    """A mask of the leaves whose paths match the patterns.

    Args:
        tree: any pytree; of its arrays only the paths are read.
        *patterns: glob patterns, applied in order: a plain one adds leaves, one that begins with
            ``!`` takes them away. If the first begins with ``!``, all leaves are the start.
        count: the number of leaves there ought to be.

    Returns:
        The tree with ``True`` at the selected leaves and ``False`` at all others.

    Raises:
        ValueError: a pattern matches nothing, or the number of leaves is not ``count``.

    >>> tree = {"gru": {"kernel": jnp.ones((2, 2)), "bias": jnp.ones(2)}, "out": jnp.ones(2)}
    >>> select(tree, "**", "!**/bias", count=2)
    {'gru': {'bias': False, 'kernel': True}, 'out': True}
    """
    names = paths(tree)
    chosen = match_paths(names, *patterns)
    if count is not None and len(chosen) != count:
        listed = ", ".join(name for name in names if name in chosen) or "none"
        raise ValueError(
            f"Patterns {', '.join(map(repr, patterns))} select {len(chosen)} leaves, "
            f"expected {count}: {listed}."
        )
    return mask_of(tree, chosen)


def mask_of(tree: PyTree, chosen: Iterable[str]) -> Mask:
    """The mask that is ``True`` at exactly the given paths."""
    chosen = frozenset(chosen)
    flags = [is_array(leaf) and path in chosen for path, leaf in _entries(tree)]
    return jax.tree.unflatten(jax.tree.structure(tree), flags)


def selected(tree: PyTree, where: Where = None) -> frozenset[str]:
    """The paths that ``where`` names in a tree.

    Args:
        tree: any pytree.
        where: ``None`` for every leaf, one pattern, a sequence of patterns, or a mask.

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
    if isinstance(where, tuple | list) and where and all(isinstance(p, str) for p in where):
        return match_paths(names, *where)
    same_structure("the mask", where, "the tree", tree)
    flags = jax.tree.leaves(where)
    return frozenset(
        path
        for (path, leaf), flag in zip(_entries(tree), flags, strict=True)
        if is_array(leaf) and bool(flag)
    )


def same_structure(name: str, tree: PyTree, other_name: str, other: PyTree) -> None:
    if jax.tree.structure(tree) != jax.tree.structure(other):
        raise ValueError(
            f"The structure of {name} is not that of {other_name}: got "
            f"{jax.tree.structure(tree)}, expected {jax.tree.structure(other)}."
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
