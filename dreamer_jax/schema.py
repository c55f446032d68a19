"""What the JSON files of a run must look like: one check for each kind of file.

A shape is a type (of a number `float`; a truth value is no number), `COUNT`, a list with one shape
for all entries, a dict from names to shapes (those that end in "?" may be missing, "*" stands for
any other name), a tuple of shapes of which one must fit, or None.
"""

from __future__ import annotations

from typing import Any

from dreamer_jax.integrity import DamagedError

COUNT = "a whole number that is not negative"

COUNTERS = {"rounds": COUNT, "updates": COUNT, "evaluations": COUNT, "averaged": COUNT}
METADATA = {
    "counters": COUNTERS,
    "replay": [[COUNT]],
    "metrics": COUNT,
    "checksums?": {"replay": [[COUNT]], "metrics": COUNT},
}
"""The metadata of a run's checkpoint."""

LEAVES = {
    "format": COUNT,
    "leaves": [
        {
            "path": [str],
            "shape": [COUNT],
            "dtype": str,
            "key_impl": (str, None),
            "stored_shape": [COUNT],
            "stored_dtype": str,
            "crc32": COUNT,
        }
    ],
}
REPLAY = {
    "format": COUNT,
    "members": COUNT,
    "tasks": COUNT,
    "image_size": COUNT,
    "action_size": COUNT,
}
DELETED = {"deleted": [[COUNT]]}
CELLS = [str]
RUN = {"spec": {"tasks": [str], "seeds": [COUNT], "config": {"*": {"*": object}}, "*": object}} | {
    name + "?": kind
    for name, kind in {"versions": {"*": str}, "revision": str, "cells": [str]}.items()
}
METRICS_ROW = {
    "kind": str,
    "member": COUNT,
    "env_steps": COUNT,
    "*": (str, float, bool, None),
}
"""A row of metrics.jsonl."""
EVALUATION_ROW = METRICS_ROW | {"task": str, "return": float}
"""One of an evaluation."""


def check_shape(value: Any, shape: Any, file: Any) -> Any:
    """The value, if it has the shape.

    Args:
      value: what was read.
      shape: see above.
      file: where from, for the message.

    Raises:
      DamagedError: it has not; names the file, the place in it, and what was expected there.
    """
    if problem := _problem(value, shape, ""):
        raise DamagedError(f"{file} is not what this program writes: {problem}")
    return value


def _problem(value: Any, shape: Any, place: str) -> str | None:
    where = place.lstrip(".") or "it"
    if isinstance(shape, dict):
        if not isinstance(value, dict):
            return f"{where} is {_shown(value)}, expected an object"
        return _problem_of_object(value, shape, place)
    if isinstance(shape, list):
        if not isinstance(value, list):
            return f"{where} is {_shown(value)}, expected a list"
        problems = (_problem(item, shape[0], f"{place}[{i}]") for i, item in enumerate(value))
        return next(filter(None, problems), None)
    shapes = shape if isinstance(shape, tuple) else (shape,)
    if any(_fits(value, one) for one in shapes):
        return None
    return f"{where} is {_shown(value)}, expected {' or '.join(map(_named, shapes))}"


def _problem_of_object(value: dict, shape: dict, place: str) -> str | None:
    known = {name.removesuffix("?"): kind for name, kind in shape.items()}
    for name in shape:
        if name not in value and name != "*" and not name.endswith("?"):
            return f"{place.lstrip('.') or 'it'} has no {name!r}"
    for name, item in value.items():
        if name not in known and "*" not in known:
            return f"{place.lstrip('.') or 'it'} has an unknown {name!r}"
        if problem := _problem(item, known.get(name, known.get("*")), f"{place}.{name}"):
            return problem
    return None


def _fits(value: Any, shape: Any) -> bool:
    if shape is object:
        return True
    if shape is None:
        return value is None
    if shape is COUNT:
        return isinstance(value, int) and not isinstance(value, bool) and value >= 0
    if shape is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return isinstance(value, shape)


def _named(shape: Any) -> str:
    names = {str: "a string", float: "a number", bool: "true or false", None: "null"}
    return shape if shape is COUNT else names[shape]


def _shown(value: Any) -> str:
    return f"{value!r:.60}"
