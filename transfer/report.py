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

from transfer.leaves import beside, is_key, wide_dtype
from transfer.select import PyTree

Array = Any


class Row(NamedTuple):
    """What is known of a leaf before any number is computed.

    Attributes:
      leaf: its path.
      rule: the patterns of the rule that claims it.
      operation: the name of the rule's operation.
      shape: its shape.
      frozen: whether the rule calls it frozen.
      rule_number: which entry of the report's `settings` and `parameters` is the rule's.
      source: the path or paths that it was made from, where they are not its own.
      columns: the numbers that there are for it: no norm for PRNG keys, none of a source that
        was not read, no cosine to one of another shape.
    """

    leaf: str
    rule: str
    operation: str
    shape: tuple[int, ...]
    frozen: bool
    rule_number: int
    source: str | None = None
    columns: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Report:
    """What happened to each leaf. A pytree, so `jit` and `vmap` can return it.

    Attributes:
      rows: one per leaf, in tree order; static.
      settings: for each rule its parameters that are not numbers; static.
      parameters: for each rule its numbers, such as `{"omega": 0.2}`.
      norm_before: Euclidean norm of each leaf of the target, float32 [n].
      norm_after: the same of the result, float32 [n].
      norm_source: the same of the source, float32 [n].
      cosine_to_source: cosine between result and source, float32 [n]; 0 where either is zero.
      unread: the leaves of the source that no rule reads, as `path`, or as `name/path` where
        sources have names; static.

    Where a number does not exist (see `Row`) the array holds NaN, the records `None` and
    the table a dash. For a population, or out of `vmap`, all arrays have a leading axis P.
    """

    rows: tuple[Row, ...]
    settings: tuple[tuple[tuple[str, Any], ...], ...]
    parameters: tuple[dict[str, Array], ...]
    norm_before: Array
    norm_after: Array
    norm_source: Array
    cosine_to_source: Array
    unread: tuple[str, ...] = ()

    @property
    def members(self) -> int | None:
        """P, or `None` for the report of a single tree."""
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
                    name: _floats(value[row.leaf] if isinstance(value, Mapping) else value)
                    for name, value in self.parameters[row.rule_number].items()
                },
                "source": row.source,
                "shape": row.shape,
                "frozen": row.frozen,
                **{
                    name: column[..., index].tolist() if name in row.columns else None
                    for name, column in columns.items()
                },
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
        table = [aligned[0], rule, *aligned[1:], rule, footer]
        if self.unread:
            more = f", ... ({len(self.unread)} in all)" if len(self.unread) > 8 else ""
            table.append(f"not read of the source: {', '.join(self.unread[:8])}{more}")
        return "\n".join(table)

    def _line(self, record: dict[str, Any]) -> tuple[str, ...]:
        arguments = ", ".join(
            f"{name}={_show(value)}" for name, value in record["parameters"].items()
        )
        if record["source"] is not None:
            arguments = ", ".join(filter(None, [arguments, f"from {record['source']}"]))
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
    Report, data_fields=["parameters", *_COLUMNS], meta_fields=["rows", "settings", "unread"]
)


def _floats(array: Array) -> Any:
    """A float32 array as Python floats that print as the float32 does: 0.2, not 0.20000000298."""
    array = np.asarray(array)
    return float(str(array[()])) if array.ndim == 0 else [_floats(item) for item in array]


def _number(value: float | list | None) -> str:
    return "-" if value is None else f"{np.mean(value):.4g}"


def _show(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list) and value and all(isinstance(item, float) for item in value):
        low, high = min(value), max(value)
        return _show(low) if low == high else f"{_show(low)}..{_show(high)}"
    return str(value)


def _split_parameters(
    arguments: Mapping[str, Any], members: int | None
) -> tuple[dict[str, Array], tuple[tuple[str, Any], ...]]:
    """Numbers, which may be traced, apart from settings, which are static and hashable."""
    numbers, settings = {}, []
    for name, value in arguments.items():
        if isinstance(value, dict) and value and all(map(_holds_numbers, value.values())):
            numbers[name] = {path: _of_members(item, members) for path, item in value.items()}
        elif _holds_numbers(value):
            numbers[name] = _of_members(value, members)
        elif value is not None:
            settings.append((name, _static(value)))
    return numbers, tuple(settings)


def _of_members(value: Any, members: int | None) -> Array:
    array = jnp.asarray(value, jnp.float32)
    if members is not None and array.shape[:1] != (members,):
        return jnp.broadcast_to(array, (members, *array.shape))
    return array


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


def summarise(
    rows: Sequence[Row],
    arguments: Sequence[Mapping[str, Any]],
    measured: Mapping[str, Mapping[str, Array]],
    *,
    members: int | None = None,
    unread: tuple[str, ...] = (),
) -> Report:
    """The report of a change.

    Args:
      rows: one per leaf, in tree order.
      arguments: the keyword arguments of each rule's operation.
      measured: the numbers of the leaves by column and path, from `measure_leaves`.
      members: P where leaves are stacked on a leading axis.
      unread: the leaves of the source that no rule reads.
    """
    split = [_split_parameters(values, members) for values in arguments]
    missing = np.full(() if members is None else (members,), np.nan, np.float32)
    columns = {}
    for name in _COLUMNS:
        column = [measured.get(name, {}).get(row.leaf, missing) for row in rows]
        # Nothing is compiled for a report without numbers.
        library = jnp if any(isinstance(value, jax.Array) for value in column) else np
        columns[name] = library.stack(column, axis=-1) if rows else missing
    rows = [
        row._replace(columns=tuple(name for name in _COLUMNS if row.leaf in measured.get(name, {})))
        for row in rows
    ]
    return Report(
        tuple(rows),
        settings=tuple(settings for _, settings in split),
        parameters=tuple(numbers for numbers, _ in split),
        **columns,
        unread=unread,
    )


def measure_leaves(
    before: Mapping[str, Array],
    after: Mapping[str, Array],
    source: Mapping[str, Array],
    *,
    population: bool,
) -> dict[str, dict[str, Array]]:
    """The numbers of a report: column -> path -> float32, a scalar or [P].

    Args:
      before: the target's leaves by path.
      after: the result's leaves by path.
      source: the source's leaves that were read, by path.
      population: whether leaves are stacked on a leading axis P.
    """
    before, after, source = map(_numbers, (before, after, source))
    source = {path: beside(leaf, after[path]) for path, leaf in source.items()}
    comparable = {path: x for path, x in source.items() if x.shape == after[path].shape}
    return _measure(before, after, source, comparable, population=population)


def _numbers(leaves: Mapping[str, Array]) -> dict[str, Array]:
    """The leaves without PRNG keys."""
    return {path: leaf for path, leaf in leaves.items() if not is_key(leaf)}


# One compiled function for the whole tree: leaf by leaf, every new shape would compile anew.
@functools.partial(jax.jit, static_argnames="population")
def _measure(
    before: PyTree, after: PyTree, source: PyTree, comparable: PyTree, *, population: bool
) -> dict[str, dict[str, Array]]:
    def inner(a, b):
        a, b = (x.astype(wide_dtype(x.dtype)) for x in (a, b))
        products = jnp.real(a * jnp.conj(b)).astype(jnp.float32)
        return products.sum(axis=tuple(range(1, a.ndim)) if population else None)

    def norms(leaves):
        return {path: jnp.sqrt(inner(leaf, leaf)) for path, leaf in leaves.items()}

    norm_after, norm_source = norms(after), norms(source)
    cosines = {}
    for path, leaf in comparable.items():
        lengths = norm_after[path] * norm_source[path]
        cosines[path] = inner(after[path], leaf) / jnp.where(lengths == 0, 1, lengths)
    return {
        "norm_before": norms(before),
        "norm_after": norm_after,
        "norm_source": norm_source,
        "cosine_to_source": cosines,
    }
