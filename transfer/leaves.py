"""One leaf at a time: the checks and small tools that the operations share.

Errors name the path of the leaf they are about, and both shapes.
"""

import zlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from transfer.select import suggest

Array = Any
Indices = slice | str | Sequence[int]

AXES = {"input": -2, "output": -1}

INITIALIZERS: dict[str, Callable[..., Callable]] = {
    "constant": jax.nn.initializers.constant,
    "glorot_normal": jax.nn.initializers.glorot_normal,
    "glorot_uniform": jax.nn.initializers.glorot_uniform,
    "he_normal": jax.nn.initializers.he_normal,
    "he_uniform": jax.nn.initializers.he_uniform,
    "lecun_normal": jax.nn.initializers.lecun_normal,
    "lecun_uniform": jax.nn.initializers.lecun_uniform,
    "normal": jax.nn.initializers.normal,
    "ones": lambda: jax.nn.initializers.ones,
    "orthogonal": jax.nn.initializers.orthogonal,
    "truncated_normal": jax.nn.initializers.truncated_normal,
    "uniform": jax.nn.initializers.uniform,
    "zeros": lambda: jax.nn.initializers.zeros,
}


def find(source: dict[str, Array], path: str) -> Array:
    """The source's leaf of a path, or an error with near misses."""
    if path not in source:
        raise ValueError(f"The source has no leaf {path!r}{suggest(path, source)}.")
    return source[path]


def check_shape(path: str, target: Array, source: Array) -> None:
    """Raise unless target and source have one shape."""
    if target.shape == source.shape:
        return
    message = (
        f"{path}: the target has shape {target.shape}, the source {source.shape}, and nothing is "
        "broadcast. "
    )
    if target.shape[1:] == source.shape:
        message += (
            "If the target is a population and the source one tree, say population=True in apply, "
            "or repeat the source with replicate(source, size=P)."
        )
    else:
        message += (
            "Use pad or crop for another size of an axis, splice to move the part that fits, or "
            "keep or reinitialise to take nothing from the source."
        )
    raise ValueError(message)


def numeric(path: str, operation: str, *leaves: Array) -> None:
    """Raise unless all leaves are floating point (or complex)."""
    for leaf in leaves:
        if not jnp.issubdtype(leaf.dtype, jnp.inexact):
            raise ValueError(
                f"{path}: {operation} needs floating-point leaves, got {leaf.dtype}; "
                "use copy or keep for this leaf."
            )


def wide(leaf: Array) -> Array:
    """A leaf in the dtype to compute in: float32 at least."""
    return leaf.astype(jnp.promote_types(leaf.dtype, jnp.float32))


def cast(path: str, result: Array, target: Array) -> Array:
    """A result in the target's dtype, or an error where JAX cannot make it."""
    if result.dtype == target.dtype:
        return result
    possible = jax.dtypes.canonicalize_dtype(target.dtype)
    if isinstance(result, jax.Array) and possible != target.dtype:
        raise ValueError(
            f"{path}: the target is {target.dtype}, which JAX does not make unless jax_enable_x64 "
            "is set; set it, or convert the target first."
        )
    return result.astype(target.dtype)


def per_member(path: str, name: str, value: Any, leaf: Array) -> Array:
    """A scalar, or [P] shaped to multiply a leaf [P, ...]."""
    shape = np.shape(value)
    if shape == ():
        return value
    if len(shape) > 1 or shape != leaf.shape[:1]:
        raise ValueError(
            f"{path}: {name} has shape {shape}; expected a scalar, or one value per member "
            f"{leaf.shape[:1]} of a population (the leaf has shape {leaf.shape})."
        )
    value = value if hasattr(value, "reshape") else np.asarray(value)
    return value.reshape(shape + (1,) * (len(leaf.shape) - 1)).astype(leaf.dtype)


def axis_number(path: str, axis: int | str, leaf: Array) -> int:
    """The position of a named axis, or of one counted from the end."""
    if isinstance(axis, str) and axis not in AXES:
        raise ValueError(f"Axis {axis!r} is not known; expected one of {sorted(AXES)} or a number.")
    number = AXES[axis] if isinstance(axis, str) else axis
    if number >= 0:
        raise ValueError(
            f"{path}: got axis {axis}; count from the end (-1 is the last), so that it means the "
            "same for one tree and for a population."
        )
    if number < -len(leaf.shape):
        raise ValueError(f"{path}: there is no axis {axis!r} in a leaf of shape {leaf.shape}.")
    return number % len(leaf.shape)


def positions(path: str, indices: Indices, size: int) -> np.ndarray:
    """Positions along an axis of the given size, int [n]."""
    if isinstance(indices, str):
        indices = slice(*(int(part) if part.strip() else None for part in indices.split(":")))
    if isinstance(indices, slice):
        if max(abs(indices.start or 0), abs(indices.stop or 0)) > size:
            raise ValueError(f"{path}: {indices} goes beyond an axis of size {size}.")
        return np.arange(size)[indices]
    numbers = np.asarray(indices, dtype=int)
    if numbers.size and not (-size <= numbers.min() and numbers.max() < size):
        raise ValueError(f"{path}: indices {indices} go beyond an axis of size {size}.")
    if len(np.unique(numbers % size)) < numbers.size:
        raise ValueError(f"{path}: indices {indices} name a position twice.")
    return numbers % size


def same_but(path: str, axis: int, target: Array, source: Array) -> None:
    """Raise unless the shapes are equal in every axis but one."""
    if target.ndim != source.ndim:
        check_shape(path, target, source)
    expected = (*target.shape[:axis], source.shape[axis], *target.shape[axis + 1 :])
    if source.shape != expected:
        raise ValueError(
            f"{path}: the target has shape {target.shape}, the source {source.shape}; they may "
            f"differ in axis {axis} only."
        )


def find_initializer(initializer: str | dict[str, Any] | Callable) -> Callable:
    """An initializer from itself, its name, or ``{"name": ..., **arguments}``."""
    if callable(initializer):
        return initializer
    arguments = dict(initializer) if isinstance(initializer, dict) else {"name": initializer}
    name = arguments.pop("name", None)
    if name not in INITIALIZERS:
        raise ValueError(f"Initializer {name!r} is not known; expected one of {[*INITIALIZERS]}.")
    return INITIALIZERS[name](**arguments)


def draw(draw: Callable, path: str, key: jax.Array, shape: tuple, dtype: Any) -> Array:
    """draw(key, shape, dtype) with the leaf's own key, member by member if there are [P] keys."""
    number = zlib.crc32(path.encode())
    single = key_ndim(key)
    if key.ndim == single:
        return draw(jax.random.fold_in(key, number), shape, dtype)
    if key.ndim != single + 1 or key.shape[:1] != shape[:1]:
        raise ValueError(
            f"{path}: got keys of shape {key.shape} for a leaf of shape {shape}; expected one key, "
            "or one for each member of a population."
        )
    one = lambda member: draw(jax.random.fold_in(member, number), shape[1:], dtype)  # noqa: E731
    return jax.vmap(one)(key)


def key_ndim(key: jax.Array) -> int:
    """The number of axes of one key: 0 if typed, 1 if made of raw integers."""
    return 0 if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else 1


def repeat(leaf: Array, size: int) -> Array:
    """A leaf [...] for each of P members, [P, ...]."""
    return jnp.broadcast_to(leaf, (size, *leaf.shape))
