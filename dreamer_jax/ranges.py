"""Settings that are numbers, each with its range declared beside it and checked in one place."""

import dataclasses
import math
import numbers
import types
import typing
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Range:
    """The values that a setting may have.

    Attributes:
      low: the smallest.
      high: the largest.
      above: whether `low` itself is left out.
      why: said of a value that is not in it; by default what the range says.
    """

    low: float
    high: float
    above: bool = False
    why: str = ""

    def __contains__(self, value: Any) -> bool:
        if isinstance(value, bool) or not isinstance(value, numbers.Real) or math.isnan(value):
            return False
        value = float(value)
        return (value > self.low if self.above else value >= self.low) and value <= self.high

    def __str__(self) -> str:
        low, high = (f"{x:,}" if isinstance(x, int) else f"{x:g}" for x in (self.low, self.high))
        return f"{'(' if self.above else '['}{low} to {high}]"

    def reason(self, value: Any) -> str:
        """What is wrong with a value, in words."""
        if self.why:
            return self.why
        if isinstance(value, numbers.Real) and float(value) > self.high:
            return "is too large"
        if self.low == 0 and not self.above:
            return "must not be negative"
        return "must be positive" if self.low in (0, 1) else f"must be at least {self.low:g}"


def setting(default: Any, low: float, high: float, *, above: bool = False, why: str = "") -> Any:
    """A field of a dataclass of settings, with its range; of a tuple, that of its entries."""
    chosen = Range(low, high, above, why)
    return dataclasses.field(default=default, metadata={"range": chosen})


def ranges(settings: Any) -> dict[str, Range]:
    """The ranges of a dataclass's fields that have one, by name."""
    fields = dataclasses.fields(settings)
    return {entry.name: entry.metadata["range"] for entry in fields if "range" in entry.metadata}


def check_ranges(settings: Any) -> None:
    """Checks every field of a dataclass that has a range or a choice of values, nested ones too.

    Raises:
      ValueError: a value is not in its range; names the setting, the value and the range.
    """
    for entry in dataclasses.fields(settings):
        value, kinds = getattr(settings, entry.name), kinds_of(entry.type)
        if dataclasses.is_dataclass(value):
            check_ranges(value)
            continue
        choices = [kind for kind in kinds if isinstance(kind, str)]
        if (value is None and type(None) in kinds) or (isinstance(value, str) and value in choices):
            continue
        if "range" in entry.metadata:
            _check(entry.name, value, entry.metadata["range"], whole=int in kinds)
        elif bool in kinds and not isinstance(value, bool):
            raise ValueError(f"{entry.name} is {value!r}, expected true or false")
        elif choices and not (int in kinds and isinstance(value, int)):
            known = ", ".join(map(repr, choices))
            raise ValueError(f"{entry.name} is {value!r}, expected one of {known}")


def _check(name: str, value: Any, allowed: Range, whole: bool) -> None:
    for one in value if isinstance(value, tuple) else (value,):
        is_whole = isinstance(one, numbers.Integral) or not whole
        if one not in allowed or not is_whole:
            kind = "a whole number" if whole else "a number"
            reason = allowed.reason(one) if is_whole else f"is not {kind}"
            raise ValueError(f"{name} is {one!r}, {reason}: expected {kind} in {allowed}")


def kinds_of(annotation: Any) -> Iterable[Any]:
    """The types and literal values that an annotation is made of."""
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) in (
        typing.Literal,
        typing.Union,
        tuple,
    ):
        return [kind for part in typing.get_args(annotation) for kind in kinds_of(part)]
    return [annotation]
