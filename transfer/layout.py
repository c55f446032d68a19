"""The layout of a leaf as data: how arrays of a foreign checkpoint become one array of the target.

A *layout* is a sequence of steps, each `{name: arguments}` or a bare name. The first step of a
rule that reads several arrays joins them; each later one changes the array:

=================================================  ================================================
`{"stack": {"axis": 0}}`                         several arrays along a new axis
`{"concatenate": {"axis": 0}}`                   several arrays along an axis: q, k, v to one
`"add"`                                          the sum of several: two biases to one
`"transpose"`, `{"transpose": [2, 1, 0]}`      all axes reversed, or in this order
`{"reshape": [8, -1]}`                           another shape of as many numbers
`{"split": {"axis": 0, "parts": 3, "index": 0}}` one of equal parts: q from q, k, v
`{"take": {"axis": 0, "index": "{i}"}}`          one slice; the axis goes: layer i of a stack
`{"reorder": {"axis": 0, "blocks": [0, 2, 1]}}`  equal blocks in another order: gates of a cell
`{"flip": {"axis": 0}}`                          backwards along an axis
=================================================  ================================================

Numbers may be captured parts of the rule's pattern, written `"{i}"`.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Array = Any
Step = tuple[str, Any]


def _library(*arrays: Array) -> Any:
    """NumPy for NumPy arrays, so that nothing is compiled for a file; else JAX."""
    return jnp if any(isinstance(array, jax.Array) for array in arrays) else np


def _stack(arrays: Sequence[Array], *, axis: int = 0) -> Array:
    return _library(*arrays).stack(arrays, axis=axis)


def _concatenate(arrays: Sequence[Array], *, axis: int = 0) -> Array:
    return _library(*arrays).concatenate(arrays, axis=axis)


def _add(arrays: Sequence[Array]) -> Array:
    if len({array.shape for array in arrays}) != 1:
        raise ValueError("they have different shapes")
    return sum(arrays[1:], start=arrays[0])


def _transpose(array: Array, axes: Sequence[int] | None = None) -> Array:
    return array.transpose(axes)


def _reshape(array: Array, shape: Sequence[int]) -> Array:
    return array.reshape(shape)


def _blocks(array: Array, axis: int, count: int) -> tuple[int, int]:
    """The axis counted from the start, and the size of each of `count` equal blocks."""
    if not -array.ndim <= axis < array.ndim:
        raise ValueError(f"there is no axis {axis}")
    axis %= array.ndim
    size, rest = divmod(array.shape[axis], count) if count > 0 else (0, 1)
    if rest:
        raise ValueError(f"axis {axis} of size {array.shape[axis]} has no {count} equal parts")
    return axis, size


def _split(array: Array, *, axis: int, parts: int, index: int) -> Array:
    axis, size = _blocks(array, axis, parts)
    if not 0 <= index < parts:
        raise ValueError(f"there is no part {index} of {parts}")
    return array[(slice(None),) * axis + (slice(index * size, (index + 1) * size),)]


def _take(array: Array, *, axis: int, index: int) -> Array:
    axis, _ = _blocks(array, axis, 1)
    if not -array.shape[axis] <= index < array.shape[axis]:
        raise ValueError(f"there is no slice {index} of {array.shape[axis]}")
    return array[(slice(None),) * axis + (index,)]


def _reorder(array: Array, *, axis: int, blocks: Sequence[int]) -> Array:
    axis, size = _blocks(array, axis, len(blocks))
    if sorted(blocks) != list(range(len(blocks))):
        raise ValueError(f"blocks {list(blocks)} are no order of {len(blocks)} blocks")
    places = np.concatenate([np.arange(block * size, (block + 1) * size) for block in blocks])
    return array[(slice(None),) * axis + (places,)]


def _flip(array: Array, *, axis: int) -> Array:
    return _library(array).flip(array, axis=axis)


JOINS: Mapping[str, Callable[..., Array]] = {
    "stack": _stack,
    "concatenate": _concatenate,
    "add": _add,
}
STEPS: Mapping[str, Callable[..., Array]] = {
    "transpose": _transpose,
    "reshape": _reshape,
    "split": _split,
    "take": _take,
    "reorder": _reorder,
    "flip": _flip,
}

_CAPTURED = re.compile(r"\{(\w+)\}")


def steps(layout: Any) -> tuple[Step, ...]:
    """The steps of a layout as (name, arguments).

    Raises:
      ValueError: an unknown step, or one that is no name or mapping of one.

    >>> steps(["transpose", {"reshape": [8, -1]}])
    (('transpose', None), ('reshape', [8, -1]))
    """
    if isinstance(layout, str | Mapping):
        layout = (layout,)
    found: list[Step] = []
    for number, step in enumerate(layout):
        if isinstance(step, Mapping) and len(step) == 1:
            ((name, arguments),) = step.items()
        else:
            name, arguments = step, None
        if not isinstance(name, str) or name not in {**JOINS, **STEPS}:
            raise ValueError(
                f"{step!r} is no step of a layout; expected one of {', '.join([*JOINS, *STEPS])}, "
                "or a mapping of it to its arguments."
            )
        if name in JOINS and number:
            raise ValueError(f"{name!r} joins several arrays, so it can only be the first step.")
        found.append((name, arguments))
    return tuple(found)


def captured_names(layout: Any) -> set[str]:
    """The captured parts that the numbers of a layout name."""
    texts: list[str] = []

    def visit(value):
        if isinstance(value, str):
            texts.append(value)
        elif isinstance(value, Mapping):
            for item in value.values():
                visit(item)
        elif isinstance(value, Sequence):
            for item in value:
                visit(item)

    for _, arguments in steps(layout):
        visit(arguments)
    return {name for text in texts for name in _CAPTURED.findall(text)}


def arrange(
    path: str, arrays: Sequence[Array], layout: Any, captures: Mapping[str, str] | None = None
) -> Array:
    """One array of the target from the arrays that its rule reads.

    Args:
      path: the target's leaf, for messages.
      arrays: what was read, one array or several.
      layout: the steps.
      captures: what the captured parts of the rule's pattern stand for.

    Raises:
      ValueError: several arrays and no step that joins them, or a step that does not fit.

    >>> q, k = np.ones((2, 3)), np.zeros((2, 3))
    >>> arrange("qk", [q, k], [{"concatenate": {"axis": 0}}, "transpose"]).shape
    (3, 4)
    """
    todo = list(steps(layout))
    if len(arrays) > 1 and not (todo and todo[0][0] in JOINS):
        raise ValueError(
            f"{path}: {len(arrays)} arrays are read for one leaf; the layout must begin with one "
            f"of {', '.join(JOINS)}."
        )
    current: Any = arrays if todo and todo[0][0] in JOINS else arrays[0]
    for name, arguments in todo:
        arguments = _filled(path, arguments, captures or {})
        shapes = [array.shape for array in current] if name in JOINS else current.shape
        operation = {**JOINS, **STEPS}[name]
        try:
            if isinstance(arguments, Mapping):
                current = operation(current, **arguments)
            elif arguments is None:
                current = operation(current)
            else:
                current = operation(current, arguments)
        except (ValueError, TypeError, IndexError) as error:
            raise ValueError(
                f"{path}: the step {name}({'' if arguments is None else arguments}) does not fit "
                f"the shape {shapes}: {error}."
            ) from None
    return current


def _filled(path: str, value: Any, captures: Mapping[str, str]) -> Any:
    """Arguments with captured parts as the numbers they are."""
    if isinstance(value, str):
        text = _CAPTURED.sub(lambda found: captures.get(found[1], found[0]), value)
        try:
            return int(text)
        except ValueError:
            raise ValueError(
                f"{path}: expected a whole number in a layout, got {text!r}."
            ) from None
    if isinstance(value, Mapping):
        return {name: _filled(path, item, captures) for name, item in value.items()}
    if isinstance(value, Sequence):
        return tuple(_filled(path, item, captures) for item in value)
    return value
