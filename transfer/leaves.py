"""One leaf at a time: the checks and small tools that the operations share.

Errors name the path of the leaf they are about, and both shapes or dtypes. Values are checked where
they are concrete; inside a traced function only shapes and dtypes can be.

Axis letters: P population member.
"""

import warnings
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from transfer.patterns import suggest

Array = Any
Indices = slice | str | Sequence[int]
Casting = Literal["no", "same_kind", "unsafe"]

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


def is_concrete(leaf: Any) -> bool:
    """Whether a leaf has values now: neither traced nor a shape alone."""
    return not isinstance(leaf, jax.core.Tracer | jax.ShapeDtypeStruct)


def is_key(leaf: Array) -> bool:
    """Whether a leaf holds typed PRNG keys."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def find(source: Mapping[str, Array], path: str) -> Array:
    """The source's leaf of a path, or an error with near misses.

    Arrays of other libraries (a PyTorch tensor) become NumPy arrays.
    """
    if path not in source:
        raise ValueError(f"The source has no leaf {path!r}{suggest(path, source)}.")
    leaf = source[path]
    if isinstance(leaf, jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct):
        return leaf
    array = np.asarray(leaf)
    if array.dtype == object:
        raise ValueError(f"{path}: the source holds a {type(leaf).__name__}, which is no array.")
    return array


# --- shapes ----------------------------------------------------------------------------------


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


# --- dtypes and devices ----------------------------------------------------------------------


def numeric(path: str, operation: str, *leaves: Array) -> None:
    """Raise unless all leaves are floating point (or complex)."""
    for leaf in leaves:
        if not jnp.issubdtype(leaf.dtype, jnp.inexact):
            raise ValueError(
                f"{path}: {operation} needs floating-point leaves, got {leaf.dtype}; "
                "use copy or keep for this leaf."
            )


def wide_dtype(dtype: Any) -> Any:
    """The dtype to compute in: float32 at least, for the 8-bit and 4-bit kinds too."""
    if not jnp.issubdtype(dtype, jnp.inexact) or jnp.finfo(dtype).bits < 32:
        return jnp.dtype(jnp.float32)
    return jnp.promote_types(dtype, jnp.float32)


def wide(path: str, leaf: Array) -> Array:
    """A leaf as a JAX array in the dtype to compute in."""
    if isinstance(leaf, jax.ShapeDtypeStruct):
        raise ValueError(
            f"{path}: this operation reads the target's values, and the target is a shape without "
            "any. Give the array, or use an operation that does not read it, such as copy."
        )
    return jnp.asarray(leaf).astype(jax.dtypes.canonicalize_dtype(wide_dtype(leaf.dtype)))


def _kind(path: str, leaf: Array) -> int:
    """bool < integer < floating point < complex."""
    for number, kind in enumerate((jnp.bool_, jnp.integer, jnp.floating, jnp.complexfloating)):
        if jnp.issubdtype(leaf.dtype, kind):
            return number
    raise ValueError(f"{path}: a leaf of dtype {leaf.dtype} holds no numbers.")


def check_casting(path: str, source: Array, target: Array, casting: str) -> None:
    """Raise unless the source's values may be stored in the target's dtype.

    Raises:
      ValueError: another kind of number under `"same_kind"`, another dtype under `"no"`;
        or values that the target's dtype cannot hold (where they are concrete).
    """
    if casting not in ("no", "same_kind", "unsafe"):
        raise ValueError(f"casting is 'no', 'same_kind' or 'unsafe'; got {casting!r}.")
    if source.dtype == target.dtype:
        return
    if is_key(source) or is_key(target):
        raise ValueError(f"{path}: the target is {target.dtype}, the source {source.dtype}.")
    if casting == "unsafe":
        return
    if casting == "no" or _kind(path, source) > _kind(path, target):
        raise ValueError(
            f"{path}: the target is {target.dtype}, the source {source.dtype}, and "
            f"casting={casting!r} does not turn one into the other. Convert one of the trees, or "
            "say casting='unsafe'."
        )
    if not is_concrete(source) or not source.size or not _narrower(source.dtype, target.dtype):
        return
    lost, vanished, span = _loss(source, target.dtype)
    if lost or vanished:
        reason = "all of which it rounds to zero" if vanished else "which it cannot hold"
        raise ValueError(
            f"{path}: the target is {target.dtype}, the source {source.dtype} with {span}, "
            f"{reason}. Choose a wider target, or say casting='unsafe'."
        )


def _loss(source: Array, dtype: Any) -> tuple[bool, bool, str]:
    """Whether a dtype cannot hold some value, or rounds all to zero; and what the values are."""
    library = jnp if isinstance(source, jax.Array) else np
    if jnp.issubdtype(dtype, jnp.integer):
        limits, low, high = jnp.iinfo(dtype), int(source.min()), int(source.max())
        return high > limits.max or low < limits.min, False, f"values from {low} to {high}"
    values = abs(source.astype(wide_dtype(source.dtype)))
    finite = library.isfinite(values)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        rounded = values.astype(dtype).astype(values.dtype)
    lost = bool((finite & ~library.isfinite(rounded)).any())
    vanished = bool(values.any()) and not bool(rounded.any())
    greatest = float(library.max(values, where=finite, initial=0))
    return lost, vanished, f"magnitudes up to {greatest:g}"


def _narrower(source: Any, target: Any) -> bool:
    """Whether the target's dtype holds a smaller range than the source's."""

    def limits(dtype):
        if jnp.issubdtype(dtype, jnp.inexact):
            info = jnp.finfo(dtype)
            return float(info.max), float(info.tiny), -float(info.max)
        if dtype == jnp.bool_:
            return 1.0, 0.0, 0.0
        return float(jnp.iinfo(dtype).max), 1.0, float(jnp.iinfo(dtype).min)

    (high, small, low), (target_high, target_small, target_low) = limits(source), limits(target)
    return target_high < high or target_low > low or target_small > small


def cast(path: str, result: Array, target: Array, *, casting: str = "same_kind") -> Array:
    """A result as a JAX array in the target's dtype, where the target lies.

    A result that is a JAX array of that dtype and place already is given back as it is; what NumPy
    holds is copied, so that a later change of the NumPy array changes nothing.
    """
    check_casting(path, result, target, casting)
    dtype = target.dtype
    if not is_key(target) and jax.dtypes.canonicalize_dtype(dtype) != dtype:
        raise ValueError(
            f"{path}: the target is {dtype}, which JAX does not make unless jax_enable_x64 "
            "is set; set it, or convert the target first."
        )
    if result.dtype != dtype:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            # What is lost is known by now, or was asked for.
            warnings.simplefilter("ignore")
            result = result.astype(dtype)
    sharding = _sharding(target)
    if not isinstance(result, jax.Array):
        # Copied by NumPy, which compiles nothing for it.
        result = jnp.asarray(np.array(result))
    if sharding is None or not is_concrete(result):
        return result
    return result if result.sharding == sharding else jax.device_put(result, sharding)


def _sharding(leaf: Array) -> jax.sharding.Sharding | None:
    """Where a leaf lies, or is to lie; `None` for NumPy and inside traced functions."""
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return leaf.sharding
    return leaf.sharding if isinstance(leaf, jax.Array) and is_concrete(leaf) else None


def beside(source: Array, target: Array) -> Array:
    """The source's leaf on the devices of the target's, so that both can be computed with."""
    sharding = _sharding(target)
    if sharding is None or not is_concrete(source):
        return source
    if isinstance(source, jax.Array):
        if source.sharding.device_set == sharding.device_set:
            return source
    elif len(sharding.device_set) == 1:
        return source
    if source.shape != target.shape and len(sharding.device_set) > 1:
        # Another shape may not divide as the target's does.
        if not isinstance(sharding, jax.sharding.NamedSharding):
            return source
        sharding = jax.sharding.NamedSharding(sharding.mesh, jax.sharding.PartitionSpec())
    return jax.device_put(source, sharding)


# --- random numbers --------------------------------------------------------------------------


def find_initializer(initializer: str | Mapping[str, Any] | Callable) -> Callable:
    """An initializer from itself, its name, or `{"name": ..., **arguments}`."""
    if callable(initializer):
        return initializer
    arguments = dict(initializer) if isinstance(initializer, Mapping) else {"name": initializer}
    name = arguments.pop("name", None)
    if name not in INITIALIZERS:
        raise ValueError(f"Initializer {name!r} is not known; expected one of {[*INITIALIZERS]}.")
    return INITIALIZERS[name](**arguments)


def check_key(key: Any) -> jax.Array:
    """The key, if it is one.

    Raises:
      ValueError: anything but a PRNG key or an array of them, typed or of raw integers.
    """
    if hasattr(key, "dtype") and hasattr(key, "shape"):
        if is_key(key):
            return key
        if key.dtype == jnp.uint32 and key.ndim and key.shape[-1] in (2, 4):
            return jnp.asarray(key)
        found = f"an array of {key.dtype} {key.shape}"
    else:
        found = repr(key)
    raise ValueError(f"Expected a PRNG key, such as jax.random.key(0); got {found}.")


def draw(
    draw: Callable, path: str, key: jax.Array, shape: tuple, dtype: Any, population: bool
) -> Array:
    """draw(key, shape, dtype) with the leaf's own key, member by member if there are [P] keys."""
    number = zlib.crc32(path.encode())
    key = check_key(key)
    single = key_ndim(key)
    if key.ndim == single:
        return draw(jax.random.fold_in(key, number), shape, dtype)
    if not population:
        raise ValueError(
            f"{path}: got keys of shape {key.shape}; expected one key. If the tree is a population "
            "with one key for each member, say population=True."
        )
    if key.ndim != single + 1 or key.shape[:1] != shape[:1]:
        raise ValueError(
            f"{path}: got keys of shape {key.shape} for a leaf of shape {shape}; expected one key, "
            "or one for each member of a population."
        )
    one = lambda member: draw(jax.random.fold_in(member, number), shape[1:], dtype)  # noqa: E731
    return jax.vmap(one)(key)


def key_ndim(key: jax.Array) -> int:
    """The number of axes of one key: 0 if typed, 1 if made of raw integers."""
    return 0 if is_key(key) else 1


def repeat(leaf: Array, size: int) -> Array:
    """A leaf [...] for each of P members, [P, ...]."""
    return jnp.broadcast_to(leaf, (size, *leaf.shape))
