"""The numbers that operations take, such as ω: their range, one for each leaf, one for each member.

Axis letters: P population member.
"""

from collections.abc import Collection, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from transfer.leaves import Array, is_concrete
from transfer.patterns import match, suggest


def numbers(
    name: str,
    value: Any,
    paths: Sequence[str],
    chosen: Collection[str],
    *,
    low: float | None = 0.0,
    high: float | None = 1.0,
) -> dict[str, Any]:
    """The number that each chosen leaf gets, by path.

    Args:
      name: what it is called in errors.
      value: a scalar or an array, for all leaves; or one for each: a mapping
        `{path, branch or pattern: number}`, or a tree such as the target's own.
      paths: those of the whole target; an entry that matches none of them is an error.
      chosen: the leaves that need a number.
      low: the least number allowed, `None` for any.
      high: the greatest number allowed, `None` for any.

    Raises:
      ValueError: a number out of range or not finite (where it is concrete), or that is none;
        a leaf with no number, or with two.
    """
    entries = _entries_of(value)
    if entries is None:
        check_range(name, value, low=low, high=high)
        return dict.fromkeys(chosen, value)
    for key, entry in entries.items():
        check_range(f"{name} of {key}", entry, low=low, high=high)
    names = {key: _names(key, paths) for key in entries}
    for key, found in names.items():
        if not found:
            raise ValueError(f"{name} has an entry {key!r} for no leaf{suggest(key, paths)}.")
    result = {}
    # In tree order, so that an error names the same leaf every time.
    for path in (path for path in paths if path in chosen):
        keys = [key for key, found in names.items() if path in found]
        if len(keys) != 1:
            listed = " and ".join(map(repr, keys)) or "none"
            raise ValueError(f"{path}: expected one entry of {name} for it, found {listed}.")
        result[path] = entries[keys[0]]
    return result


def _entries_of(value: Any) -> dict[str, Any] | None:
    """A tree or mapping of numbers as `{path: number}`; `None` for one number or array."""
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        return None
    if jax.tree_util.all_leaves([value]):
        return None
    leaves, _ = jax.tree_util.tree_flatten_with_path(value, is_leaf=lambda x: isinstance(x, list))
    return {
        jax.tree_util.keystr(key, simple=True, separator="/"): leaf
        for key, leaf in leaves
        if leaf is not None
    }


def _names(key: str, paths: Sequence[str]) -> frozenset[str]:
    """The leaves that an entry is for: a path, all below a branch, or what a pattern matches."""
    if key in paths:
        return frozenset({key})
    return frozenset(path for path in paths if path.startswith(f"{key}/") or match(key, path))


def check_range(name: str, value: Any, *, low: float | None, high: float | None) -> None:
    """Raise for a number that is out of range or not finite, where it is concrete."""
    if any(not is_concrete(item) for item in jax.tree.leaves(value)):
        return
    if low is not None and high is not None:
        wanted = f"in [{low:g}, {high:g}]"
    else:
        wanted = "that are finite" if low is None else f"of {low:g} or more"
    try:
        found = np.asarray(value)
        if found.dtype.kind not in "biuf" and not jnp.issubdtype(found.dtype, jnp.floating):
            raise TypeError
        found = found.astype(np.float64)
    except (TypeError, ValueError):
        hint = ""
        if isinstance(value, str):
            hint = " (YAML takes a number such as 1e-3 for text: write 1.0e-3)"
        raise ValueError(f"{name} is {value!r}; expected numbers {wanted}{hint}.") from None
    wrong = ~np.isfinite(found)
    # A number rounded to float32 may lie one rounding beyond the bound.
    if low is not None:
        wrong |= found < low - 1e-6 * abs(low)
    if high is not None:
        wrong |= found > high + 1e-6 * abs(high)
    if wrong.any():
        shown = found[wrong].ravel()[0] if found.ndim else found
        raise ValueError(f"{name} is {shown:g}; expected numbers {wanted}.")


def per_member(path: str, name: str, value: Any, leaf: Array, population: bool) -> Array:
    """A scalar, or [P] shaped to multiply a leaf [P, ...] of a population."""
    shape = np.shape(value)
    if shape == ():
        return value
    if not population:
        raise ValueError(
            f"{path}: {name} has shape {shape}; expected a scalar. If the tree is a population and "
            "these are one value per member, say population=True."
        )
    if len(shape) > 1 or shape != leaf.shape[:1]:
        raise ValueError(
            f"{path}: {name} has shape {shape}; expected a scalar, or one value per member "
            f"{leaf.shape[:1]} of a population (the leaf has shape {leaf.shape})."
        )
    return jnp.asarray(value).reshape(shape + (1,) * (len(leaf.shape) - 1)).astype(leaf.dtype)
