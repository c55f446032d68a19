"""What a plan did to every leaf: a table for people, records for programs.

Axis letters: P population member; n leaves of the target.
"""

import dataclasses
import functools
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from transfer.select import PyTree

Array = Any


class Row(NamedTuple):
    """What is known of a leaf before any number is computed."""

    leaf: str
    rule: str
    operation: str
    shape: tuple[int, ...]
    frozen: bool
    rule_number: int


@dataclasses.dataclass(frozen=True)
class Report:
    """What happened to each leaf. A pytree, so ``jit`` and ``vmap`` can return it.

    Attributes:
        rows: one per leaf, in tree order; static.
        settings: for each rule its parameters that are not numbers; static.
        parameters: for each rule its numbers, such as ``{"omega": 0.2}``.
        norm_before: Euclidean norm of each leaf of the target, float32 [n].
        norm_after: the same of the result, float32 [n].
        norm_source: the same of the source, float32 [n]; NaN where no source was read.
        cosine_to_source: cosine between result and source, float32 [n]; NaN where no source was
            read, where its shape is another, and where either is zero.

    For a population, or out of ``vmap``, all arrays have a leading axis P.
    """

    rows: tuple[Row, ...]
    settings: tuple[tuple[tuple[str, Any], ...], ...]
    parameters: tuple[dict[str, Array], ...]
    norm_before: Array
    norm_after: Array
    norm_source: Array
    cosine_to_source: Array

    @property
    def members(self) -> int | None:
        """P, or ``None`` for the report of a single tree."""
        return self.norm_after.shape[0] if self.norm_after.ndim > 1 else None

    def member(self, index: int) -> "Report":
        """The report of one member of a population."""
        if self.members is None:
            raise ValueError("This is the report of a single tree; it has no members.")
        return jax.tree.map(lambda array: array[index], self)

    def records(self) -> list[dict[str, Any]]:
        """One dictionary per leaf, of plain Python values; lists of P of them for a population.

        Raises:
            ValueError: inside a traced function, where there are no values yet.
        """
        self._require_values()
        columns = {name: np.asarray(getattr(self, name)) for name in _COLUMNS}
        return [
            {
                "leaf": row.leaf,
                "rule": row.rule,
                "operation": row.operation,
                "parameters": dict(self.settings[row.rule_number])
                | {
                    name: np.asarray(value).tolist()
                    for name, value in self.parameters[row.rule_number].items()
                },
                "shape": row.shape,
                "frozen": row.frozen,
                **{name: column[..., index].tolist() for name, column in columns.items()},
            }
            for index, row in enumerate(self.rows)
        ]

    def __str__(self) -> str:
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(self)):
            return f"Report of {len(self.rows)} leaves, still traced: return it from the function."
        header = ("leaf", "shape", "operation", "before", "after", "source", "cosine")
        lines = [header, *(self._line(record) for record in self.records())]
        widths = [max(len(line[column]) for line in lines) for column in range(len(header))]
        aligned = [
            "  ".join(
                cell.ljust(width) if column < 3 else cell.rjust(width)
                for column, (cell, width) in enumerate(zip(line, widths, strict=True))
            ).rstrip()
            for line in lines
        ]
        counts = Counter(row.operation for row in self.rows)
        total = ", ".join(f"{count} {operation}" for operation, count in counts.items())
        footer = f"{len(self.rows)} leaves: {total}"
        if self.members is not None:
            footer += f"; numbers are means over {self.members} members"
        rule = "-" * max(map(len, aligned))
        return "\n".join([aligned[0], rule, *aligned[1:], rule, footer])

    def _line(self, record: dict[str, Any]) -> tuple[str, ...]:
        arguments = ", ".join(
            f"{name}={_show(value)}" for name, value in record["parameters"].items()
        )
        return (
            record["leaf"],
            "x".join(map(str, record["shape"])) or "scalar",
            f"{record['operation']}({arguments})" + (", frozen" if record["frozen"] else ""),
            *(_number(record[name]) for name in _COLUMNS),
        )

    def _require_values(self) -> None:
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(self)):
            raise ValueError("The report is still traced; return it from the traced function.")


_COLUMNS = ("norm_before", "norm_after", "norm_source", "cosine_to_source")

jax.tree_util.register_dataclass(
    Report, data_fields=["parameters", *_COLUMNS], meta_fields=["rows", "settings"]
)


def _number(value: float | list) -> str:
    values = np.asarray(value)
    if np.isnan(values).all():
        return "-"
    return f"{np.nanmean(values):.4g}"


def _show(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list) and value and all(isinstance(item, float) for item in value):
        low, high = min(value), max(value)
        return _show(low) if low == high else f"{_show(low)}..{_show(high)}"
    return str(value)


def split_parameters(
    arguments: Mapping[str, Any], members: int | None
) -> tuple[dict[str, Array], tuple[tuple[str, Any], ...]]:
    """Numbers, which may be traced, apart from settings, which are static and hashable."""
    numbers, settings = {}, []
    for name, value in arguments.items():
        if _holds_numbers(value):
            numbers[name] = jnp.asarray(value, jnp.float32)
            if members is not None and numbers[name].shape[:1] != (members,):
                numbers[name] = jnp.broadcast_to(numbers[name], (members, *numbers[name].shape))
        elif value is not None:
            settings.append((name, _static(value)))
    return numbers, tuple(settings)


def _holds_numbers(value: Any) -> bool:
    """Whether a parameter is a number such as ω, not a static axis or a list of positions."""
    if isinstance(value, list | tuple):
        return any(_holds_numbers(item) for item in value)
    return isinstance(value, float) or hasattr(value, "dtype")


def _static(value: Any) -> Any:
    if isinstance(value, bool | int | str):
        return value
    if isinstance(value, slice):
        return ":".join("" if end is None else str(end) for end in (value.start, value.stop))
    if isinstance(value, Mapping):
        return ", ".join(f"{name}={item}" for name, item in value.items())
    if isinstance(value, Sequence):
        return tuple(value)
    return getattr(value, "__name__", str(value))


def measure(
    rows: Sequence[Row],
    arguments: Sequence[Mapping[str, Any]],
    before: Mapping[str, Array],
    after: Mapping[str, Array],
    source: Mapping[str, Array],
    *,
    members: int | None = None,
) -> Report:
    """The report of a change.

    Args:
        rows: one per leaf, in tree order.
        arguments: the keyword arguments of each rule's operation.
        before: the target's leaves by path.
        after: the result's leaves by path.
        source: the source's leaves that were read, by path.
        members: P where leaves are stacked on a leading axis.
    """
    split = [split_parameters(values, members) for values in arguments]
    comparable = {
        path: leaf
        for path, leaf in source.items()
        if leaf.shape == after[path].shape and _is_number(leaf)
    }
    numbers = _norms(
        *(_numbers(leaves) for leaves in (before, after, source)),
        comparable,
        population=members is not None,
    )
    missing = jnp.full(() if members is None else (members,), jnp.nan)
    columns = {
        name: jnp.stack([numbers[name].get(row.leaf, missing) for row in rows], axis=-1)
        for name in _COLUMNS
    }
    return Report(
        tuple(rows), tuple(s for _, s in split), tuple(numbers for numbers, _ in split), **columns
    )


def _is_number(leaf: Array) -> bool:
    return not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _numbers(leaves: Mapping[str, Array]) -> dict[str, Array]:
    return {path: leaf for path, leaf in leaves.items() if _is_number(leaf)}


# One compiled function for the whole tree: leaf by leaf, every new shape would compile anew.
@functools.partial(jax.jit, static_argnames="population")
def _norms(
    before: PyTree, after: PyTree, source: PyTree, comparable: PyTree, *, population: bool
) -> dict[str, dict[str, Array]]:
    def inner(a, b):
        a, b = a.astype(jnp.float32), b.astype(jnp.float32)
        return jnp.sum(a * b, axis=tuple(range(1, a.ndim)) if population else None)

    norm = lambda leaves: {path: jnp.sqrt(inner(x, x)) for path, x in leaves.items()}  # noqa: E731
    norms = {
        "norm_before": norm(before),
        "norm_after": norm(after),
        "norm_source": norm(source),
    }
    norms["cosine_to_source"] = {
        path: inner(after[path], other) / (norms["norm_after"][path] * norms["norm_source"][path])
        for path, other in comparable.items()
    }
    return norms
