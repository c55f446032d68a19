"""What the rules of a plan read: which sources, which of their leaves, in which layout.

Axis letters: P population member.
"""

import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax

from transfer.layout import JOINS, arrange, steps
from transfer.leaves import find, repeat
from transfer.patterns import escape, match, suggest
from transfer.plan import Plan, Rule
from transfer.select import Leaves, PyTree, flatten

Array = Any


class Once(Leaves):
    """One leaf of a view, read once and kept for the report."""

    def __init__(self, view: "View", path: str, held: dict[str, Array]):
        self._view, self._path, self._held = view, path, held

    def __getitem__(self, path: str) -> Array:
        if path not in self._held:
            self._held[path] = self._view[path]
        return self._held[path]

    def __contains__(self, path: object) -> bool:
        return path == self._path and path in self._view

    def __iter__(self) -> Iterator[str]:
        return iter((self._path,) if self._path in self._view else ())

    def __len__(self) -> int:
        return 1 if self._path in self._view else 0


class View(Leaves):
    """A source as a rule reads it: by the target's paths, in the target's layout."""

    def __init__(self, rule, tree, places, target, members):
        self._rule, self._tree, self._places = rule, tree, places
        self._target, self._members = target, members
        # What is made of arrays in memory is made once; of a file it would fill the memory.
        self._made: dict[str, Array] | None = None if isinstance(tree, Leaves) else {}

    def __getitem__(self, path: str) -> Array:
        if path not in self._places:
            return find(self._tree, path)
        if self._made is not None and path in self._made:
            return self._made[path]
        made = self._arranged(path, [find(self._tree, place) for place in self._places[path]])
        if self._made is not None:
            self._made[path] = made
        return made

    def _arranged(self, path: str, arrays: Sequence[Array]) -> Array:
        rule = self._rule
        leaf = arrays[0]
        if rule.layout or len(arrays) > 1:
            leaf = arrange(path, arrays, rule.layout, rule.captured(path))
        # All members share what has one axis less than the target's.
        if self._members is not None and leaf.ndim == self._target[path].ndim - 1:
            return repeat(leaf, self._members)
        return leaf

    @property
    def shapes(self) -> Mapping[str, jax.ShapeDtypeStruct]:
        known = self._tree.shapes if isinstance(self._tree, Leaves) else self._tree
        found = {}
        for path, places in self._places.items():
            leaves = [find(known, place) for place in places]
            shapes = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves]
            found[path] = jax.eval_shape(lambda *x, path=path: self._arranged(path, x), *shapes)
        return found

    def __contains__(self, path: object) -> bool:
        return all(place in self._tree for place in self._places.get(path, (path,)))

    def __iter__(self) -> Iterator[str]:
        names = dict.fromkeys((*self._tree, *self._places))
        return (path for path in names if path in self)

    def __len__(self) -> int:
        return sum(1 for _ in self)


def flat_sources(plan: Plan, source: PyTree) -> dict[str | None, Mapping[str, Array]]:
    """The sources by name, flat; `None` names the only one."""
    named = any(reading.name is not None for rule in plan.rules for reading in rule.readings)
    if source is None:
        return {}
    if not named:
        return {None: flatten(source)}
    if not isinstance(source, Mapping) or isinstance(source, Leaves):
        raise ValueError(
            f"Rules of the plan name their sources; give apply {{name: tree}}, "
            f"got {type(source).__name__}."
        )
    return {name: flatten(tree) for name, tree in source.items()}


def reads(
    rule: Rule,
    signature: Mapping[str, inspect.Parameter],
    mine: Sequence[str],
    sources: Mapping[str | None, Mapping[str, Array]],
) -> Iterator[tuple[str | None, Mapping[str, Array], dict[str, tuple[str, ...]]]]:
    """What a rule reads: source, its leaves, and which of them each leaf of the target needs."""
    several = "sources" in signature
    if not several and "source" not in signature:
        return
    if not sources:
        raise ValueError(f"The rule '{rule}' reads a source; give apply one.")
    readings = rule.readings
    if several:
        if None in sources:
            raise ValueError(
                f"The rule '{rule}' reads several sources; name them in the rule, as in "
                "source=('first', 'second'), and give apply {name: tree}."
            )
        if not isinstance(rule.source, tuple):
            raise ValueError(
                f"The rule '{rule}' needs a tuple of source names, got {rule.source!r}; given are "
                f"{', '.join(map(str, sources))}."
            )
    elif len({reading.name for reading in readings}) > 1 or (
        len(readings) > 1 and any(reading.path is None for reading in readings)
    ):
        raise ValueError(
            f"The rule '{rule}' needs the name of one source, got {rule.source!r}. Several paths "
            "of one source are joined by a layout; operations such as average read several."
        )
    for number, reading in enumerate(readings):
        if reading.name is None and None not in sources:
            raise ValueError(
                f"The rule '{rule}' needs the name of one source, got {rule.source!r}; given are "
                f"{', '.join(map(str, sources))}."
            )
        if reading.name not in sources:
            raise ValueError(
                f"The rule '{rule}' reads the source {reading.name!r}; given are "
                f"{', '.join(map(str, sources))}."
            )
        tree = sources[reading.name]
        yield (
            reading.name,
            tree,
            {
                path: source_places(rule, path, tree, number=number if several else None)
                for path in mine
            },
        )
        if not several:
            return


def source_places(
    rule: Rule, path: str, tree: Mapping[str, Array], *, number: int | None = None
) -> tuple[str, ...]:
    """The paths in a source that a leaf of the target is made from.

    Args:
      rule: the rule that claims the leaf.
      path: the leaf's path.
      tree: the source's leaves by path.
      number: which of the rule's entries for its sources is meant; `None` for all together.
    """
    readings = rule.readings if number is None else (rule.readings[number],)
    found: list[str] = []
    captured = rule.captured(path)
    for reading in readings:
        if reading.path is None:
            found.append(path)
            continue
        template = re.sub(
            r"(?<!\\)\{(\w+)\}", lambda hit: captured.get(hit[1], hit[0]), reading.path
        )
        if not re.search(r"(?<!\\)\*", template):
            found.append(re.sub(r"\\(.)", r"\1", template))
            continue
        template = re.sub(r"(?<!\\)\{(\w+)\}", lambda hit: escape(captured[hit[1]]), reading.path)
        names = sorted((name for name in tree if match(template, name)), key=natural)
        if not names:
            raise ValueError(
                f"{path}: the source has no leaf {template!r}{suggest(template, tree)}."
            )
        found += names
    joins = bool(rule.layout) and steps(rule.layout)[0][0] in JOINS
    if len(found) > 1 and not joins:
        raise ValueError(
            f"{path}: the rule '{rule}' reads {len(found)} leaves, {', '.join(found)}, and its "
            f"layout does not begin with one of {', '.join(JOINS)}."
        )
    return tuple(found)


def natural(name: str) -> list[Any]:
    """What to sort by so that layers/2 comes before layers/10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]
