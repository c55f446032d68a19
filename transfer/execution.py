"""Plans carried out: on a tree, on shapes alone (a dry run), or leaf by leaf from a file.

Axis letters: P population member.
"""

import inspect
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from transfer import merging, surgery
from transfer import population as populations
from transfer.layout import JOINS, arrange, steps
from transfer.leaves import check_key, find, key_ndim, numbers, repeat
from transfer.plan import Operations, Plan, Rule, claims, is_gradient
from transfer.report import Report, Row, measure_leaves, summarise
from transfer.select import Leaves, PyTree, escape, flatten, mask_of, match, suggest, unflatten

Array = Any

OPERATIONS: Operations = {
    operation.__name__: operation
    for operation in (
        surgery.keep,
        surgery.copy,
        surgery.fraction,
        surgery.interpolate,
        surgery.shrink_perturb,
        surgery.reinitialise,
        surgery.take,
        surgery.splice,
        surgery.pad,
        surgery.crop,
        merging.average,
        merging.slerp,
        merging.task_arithmetic,
        merging.ties,
        merging.dare,
        merging.breadcrumbs,
        merging.model_stock,
        merging.karcher_mean,
    )
}


def source_leaves(
    plan: Plan, target: PyTree, source: PyTree, *, operations: Operations = OPERATIONS
) -> dict[str, Any]:
    """The leaves of a source that the plan reads, as a flat ``{path: array}``.

    Sources that differ where the plan does not look (another action size) are alike in these, so
    they can be stacked; the result is a valid source for :func:`apply`. For plans of one source.

    Raises:
        ValueError: as :func:`transfer.claims`, or a leaf the plan reads that the source has not.
    """
    flat, names = flatten(source), {}
    for path, rule in claims(plan, target).items():
        if "source" in _signature(rule, operations):
            names |= dict.fromkeys(source_places(rule, path, flat))
    return {name: find(flat, name) for name in names}


def apply(
    plan: Plan,
    target: PyTree,
    source: PyTree = None,
    *,
    key: jax.Array | None = None,
    population: bool = False,
    strict: bool = False,
    measure: bool = True,
    operations: Operations = OPERATIONS,
    **parameters: Any,
) -> tuple[PyTree, Report]:
    """Carry out a plan.

    Args:
        plan: the plan.
        target: the tree to change; never altered. If it has shapes in place of arrays
            (``jax.ShapeDtypeStruct``, as from ``jax.eval_shape``), this is a dry run: everything
            but values is checked, and the new tree has shapes too.
        source: the tree that knowledge comes from; where rules name their sources, a mapping
            ``{name: tree}``. A file from :func:`transfer.open_file` is read leaf by leaf.
        key: one PRNG key, for the operations that draw. Leaves draw independently.
        population: whether the target's leaves are stacked on a leading axis P. Source leaves may
            be stacked too or shared by all members; parameters may be scalars or [P]; each member
            gets a key of its own; the report has a row of numbers for each member.
        strict: whether a leaf of the source that no rule reads is an error. Otherwise it is listed
            in the report's ``unread``.
        measure: whether the report has norms and cosines, which take a pass over all leaves.
        operations: what the names in the plan mean; extend ``OPERATIONS`` with your own.
        **parameters: values for what the rules leave open, such as ``omega=0.2``; they go to
            every rule whose operation has a parameter of this name that the plan does not set.
            A value may be a mapping ``{path, branch or pattern: number}`` or a tree, which gives
            each leaf its own, traced and differentiable too.

    Returns:
        The new tree and a :class:`Report`. Under ``vmap`` both get a leading axis.

    Raises:
        ValueError: as :func:`transfer.claims`; or a parameter, key or source that is missing or
            unused; or as the operations.
    """
    work = _prepare(
        plan, target, source, key, population, strict, operations=operations, given=parameters
    )
    shapes = [*work.before.values(), *(x for tree in work.sources.values() for x in _values(tree))]
    if any(isinstance(leaf, jax.ShapeDtypeStruct) for leaf in shapes):
        return _dry_run(work, target)
    if any(isinstance(tree, Leaves) for tree in work.sources.values()):
        return _leaf_by_leaf(work, target, measure=measure)
    result = target
    for step in work.steps:
        where = mask_of(result, step.paths)
        result = step.operation(result, *step.inputs, where=where, **step.plain_keywords)
    measured = {}
    if measure:
        read = {
            path: step.inputs[0][path]
            for step in work.steps
            if step.reads_one
            for path in step.paths
            if path in step.inputs[0]
        }
        measured = measure_leaves(work.before, flatten(result), read, population=population)
    return result, work.report(measured)


def stream(
    plan: Plan,
    target: PyTree,
    source: PyTree = None,
    *,
    key: jax.Array | None = None,
    population: bool = False,
    strict: bool = False,
    measure: bool = True,
    operations: Operations = OPERATIONS,
    **parameters: Any,
) -> tuple[PyTree, Report]:
    """Carry out a plan leaf by leaf, with no more of the sources in memory than one leaf reads.

    As :func:`apply`, but for two things. Each operation sees one leaf at a time, as
    ``{path: array}``. And the target may have shapes in place of arrays (``jax.ShapeDtypeStruct``)
    where the operation does not read the target's values: ``copy``, ``take``, ``crop``, ``pad``
    with a ``fill``, ``reinitialise`` and ``average``. An array is made for each, on the devices
    that the shape's ``sharding`` names, so that neither a whole target nor a whole source exists.

    Raises:
        ValueError: as :func:`apply`; or a shape of the target whose operation reads its values.

    >>> plan = Plan((Rule("**", "copy"),))
    >>> target = {"w": jax.ShapeDtypeStruct((2,), jnp.bfloat16)}
    >>> stream(plan, target, {"w": jnp.ones(2)})[0]
    {'w': Array([1, 1], dtype=bfloat16)}
    """
    work = _prepare(
        plan, target, source, key, population, strict, operations=operations, given=parameters
    )
    return _leaf_by_leaf(work, target, measure=measure)


class _Step(NamedTuple):
    """One rule ready to be carried out."""

    rule: Rule
    operation: Callable[..., PyTree]
    paths: tuple[str, ...]
    inputs: tuple[Any, ...]
    """None, one mapping, or one list of mappings."""
    keywords: dict[str, Any]

    @property
    def plain_keywords(self) -> dict[str, Any]:
        return {
            name: dict(value) if isinstance(value, _PerLeaf) else value
            for name, value in self.keywords.items()
        }

    @property
    def reads_one(self) -> bool:
        return bool(self.inputs) and isinstance(self.inputs[0], Mapping)


class _Work(NamedTuple):
    """A plan with everything that it needs."""

    steps: list[_Step]
    before: Mapping[str, Array]
    sources: dict[str | None, Mapping[str, Array]]
    rows: list[Row]
    arguments: list[dict[str, Any]]
    unread: tuple[str, ...]
    members: int | None

    def report(self, measured: Mapping[str, Mapping[str, Array]]) -> Report:
        return summarise(
            self.rows, self.arguments, measured, members=self.members, unread=self.unread
        )


def _values(tree: Mapping[str, Array]) -> Sequence[Array]:
    return () if isinstance(tree, Leaves) else tuple(tree.values())


def _prepare(plan, target, source, key, population, strict, *, operations, given) -> _Work:
    claimed = claims(plan, target)
    before = flatten(target)
    members = populations.size(target) if population else None
    if key is not None:
        key = check_key(key)
        if population and key.ndim == key_ndim(key):
            key = jax.random.split(key, members)
    sources = _flat_sources(plan, source, operations)
    rules = tuple({id(rule): rule for rule in claimed.values()}.values())
    work, arguments, read = [], [], {name: set() for name in sources}
    for rule in rules:
        mine = tuple(path for path in before if claimed[path] is rule)
        signature = _signature(rule, operations)
        operation = operations[rule.operation]
        own = _arguments(rule, signature, given)
        own = {
            name: _resolved(rule, name, value, mine, before, operation)
            for name, value in own.items()
        }
        arguments.append(own)
        keywords = dict(own)
        if "population" in signature:
            keywords["population"] = population
        if "key" in signature:
            if key is None:
                raise ValueError(f"The rule '{rule}' draws random numbers; give apply a key.")
            keywords["key"] = key
        views = []
        for name, tree, places in _reads(rule, signature, mine, sources):
            read[name] |= {place for found in places.values() for place in found}
            views.append(_View(rule, tree, places, before, members))
            for path, needed in places.items():
                if missing := [place for place in needed if place != path and place not in tree]:
                    raise ValueError(
                        f"{path}: the rule '{rule}' reads {missing[0]!r}, which the source has "
                        f"not{suggest(missing[0], tree)}."
                    )
        inputs = (views,) if "sources" in signature else tuple(views)
        work.append(_Step(rule, operation, mine, inputs, keywords))
    _check_all_used(plan, rules, arguments, given)
    unread = tuple(
        path if name is None else f"{name}/{path}"
        for name, tree in sources.items()
        for path in tree
        if path not in read[name]
    )
    if strict and unread:
        raise ValueError(
            f"No rule reads {len(unread)} leaves of the source: {', '.join(unread)}. Add a rule, "
            "or leave them out of the source."
        )
    numbered = {id(rule): number for number, rule in enumerate(rules)}
    rows = [
        Row(
            leaf=path,
            rule=", ".join(claimed[path].patterns),
            operation=claimed[path].operation,
            shape=leaf.shape,
            frozen=claimed[path].frozen,
            rule_number=numbered[id(claimed[path])],
            source=_renamed(claimed[path], path, sources, operations),
        )
        for path, leaf in before.items()
    ]
    return _Work(work, before, sources, rows, arguments, unread, members)


def _dry_run(work: _Work, target: PyTree) -> tuple[PyTree, Report]:
    """The shapes of what the plan would make; all checks but those of values are made."""

    def shape(leaf):
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)

    before = {path: shape(leaf) for path, leaf in work.before.items()}

    def run(leaves, read):
        result = dict(leaves)
        for step, inputs in zip(work.steps, read, strict=True):
            where = dict.fromkeys(result, False) | dict.fromkeys(step.paths, True)
            result = step.operation(result, *inputs, where=where, **step.plain_keywords)
        return result

    read = [
        jax.tree.map(lambda view: view.shapes, step.inputs, is_leaf=lambda x: isinstance(x, _View))
        for step in work.steps
    ]
    after = jax.eval_shape(run, before, read)
    new = {
        path: jax.ShapeDtypeStruct(
            leaf.shape, leaf.dtype, sharding=getattr(work.before[path], "sharding", None)
        )
        for path, leaf in after.items()
    }
    return unflatten(target, new), work.report({})


def _leaf_by_leaf(work: _Work, target: PyTree, *, measure: bool) -> tuple[PyTree, Report]:
    new: dict[str, Array] = {}
    measured: dict[str, dict[str, Array]] = {}
    for step in work.steps:
        for path in step.paths:
            leaf = work.before[path]
            held: dict[str, Array] = {}
            inputs = jax.tree.map(
                lambda view, path=path, held=held: _Once(view, path, held),
                step.inputs,
                is_leaf=lambda x: isinstance(x, _View),
            )
            keywords = {
                name: value[path] if isinstance(value, _PerLeaf) else value
                for name, value in step.keywords.items()
            }
            made = step.operation({path: leaf}, *inputs, where={path: True}, **keywords)[path]
            if isinstance(made, jax.ShapeDtypeStruct):
                raise ValueError(
                    f"{path}: the rule '{step.rule}' keeps the target's values, and the target is "
                    "a shape without any. Give the array, or draw it with reinitialise."
                )
            new[path] = made
            if measure:
                known = {} if isinstance(leaf, jax.ShapeDtypeStruct) else {path: leaf}
                read = held if step.reads_one else {}
                found = measure_leaves(
                    known, {path: made}, read, population=work.members is not None
                )
                for name, column in found.items():
                    measured.setdefault(name, {}).update(column)
            # A device that lags behind would keep what was read for it.
            jax.block_until_ready(made)
    return unflatten(target, new), work.report(measured)


class _Once(Leaves):
    """One leaf of a view, read once and kept for the report."""

    def __init__(self, view: "_View", path: str, held: dict[str, Array]):
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


class _View(Leaves):
    """A source as a rule reads it: by the target's paths, in the target's layout."""

    def __init__(self, rule, tree, places, target, members):
        self._rule, self._tree, self._places = rule, tree, places
        self._target, self._members = target, members

    def __getitem__(self, path: str) -> Array:
        if path not in self._places:
            return find(self._tree, path)
        return self._arranged(path, [find(self._tree, place) for place in self._places[path]])

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


# --- sources ---------------------------------------------------------------------------------


def _flat_sources(
    plan: Plan, source: PyTree, operations: Operations
) -> dict[str | None, Mapping[str, Array]]:
    """The sources by name, flat; ``None`` names the only one."""
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


def _reads(
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
        number: which of the rule's entries for its sources is meant; ``None`` for all together.
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


def _renamed(rule, path, sources, operations) -> str | None:
    """What a leaf is made from, where that is not the leaf of the same path."""
    signature = _signature(rule, operations)
    if "source" not in signature or not any(reading.path for reading in rule.readings):
        return None
    ((_, _, places),) = _reads(rule, signature, (path,), sources)
    return ", ".join(places[path])


# --- parameters ------------------------------------------------------------------------------


class _PerLeaf(dict):
    """A number for each leaf of a rule, by path."""


def _resolved(rule, name, value, mine, before, operation) -> Any:
    """A parameter that differs between leaves as ``{path: number}``; any other as it is."""
    if is_gradient(value):
        return _PerLeaf(_gradient(rule, name, value, mine))
    value = _plain(value)
    known = OPERATIONS.get(operation.__name__) is operation
    if not known or name == "initializer" or jax.tree_util.all_leaves([value]):
        return value
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        return value
    return _PerLeaf(numbers(name, value, list(before), mine, low=None, high=None))


def _plain(value: Any) -> Any:
    """The mappings of a rule as dictionaries, which JAX knows as trees."""
    if isinstance(value, Mapping) and not isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    return value


def _gradient(rule: Rule, name: str, value: Mapping, mine: Sequence[str]) -> dict[str, Any]:
    """The number of each leaf where ``values`` are spread over a captured part."""
    depths = {path: rule.captured(path).get(value["over"]) for path in mine}
    if None in depths.values():
        raise ValueError(
            f"{name} of the rule '{rule}' is spread over {{{value['over']}}}, which its pattern "
            "does not capture."
        )
    order = sorted(set(depths.values()), key=natural)
    values = value["values"]
    knots = [jnp.asarray(knot, jnp.float32) for knot in values] if np.ndim(values) else []
    if not knots:
        raise ValueError(f"{name} of the rule '{rule}' needs a list of values, got {values!r}.")
    spread = {}
    for number, depth in enumerate(order):
        at = number / max(1, len(order) - 1) * (len(knots) - 1)
        low = min(int(at), max(0, len(knots) - 2))
        high = min(low + 1, len(knots) - 1)
        spread[depth] = (1 - (at - low)) * knots[low] + (at - low) * knots[high]
    return {path: spread[depth] for path, depth in depths.items()}


def _signature(rule: Rule, operations: Operations) -> Mapping[str, inspect.Parameter]:
    if rule.operation not in operations:
        raise ValueError(
            f"The rule '{rule}' names no known operation; expected one of {', '.join(operations)}."
        )
    return inspect.signature(operations[rule.operation]).parameters


def _arguments(
    rule: Rule, signature: Mapping[str, inspect.Parameter], parameters: Mapping[str, Any]
) -> dict[str, Any]:
    """The keyword arguments of a rule's operation: from the plan, else from the caller."""
    names = [
        name
        for name, parameter in signature.items()
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY
        and name not in ("where", "key", "population")
    ]
    for name in rule.parameters:
        if name not in names:
            raise ValueError(
                f"The rule '{rule}' sets {name!r}; the parameters of {rule.operation} are "
                f"{', '.join(names) or 'none'}."
            )
    given = {name: parameters[name] for name in names if name in parameters} | dict(rule.parameters)
    for name in names:
        if name not in given and signature[name].default is inspect.Parameter.empty:
            raise ValueError(
                f"The rule '{rule}' leaves {name!r} open; set it in the plan or give apply "
                f"{name}=..."
            )
    return given


def _check_all_used(
    plan: Plan, rules: Sequence[Rule], arguments: Sequence[Mapping], parameters: Mapping[str, Any]
) -> None:
    used = {
        name
        for rule, given in zip(rules, arguments, strict=True)
        for name in set(given) - set(rule.parameters)
    }
    if unused := sorted(set(parameters) - used):
        raise ValueError(
            f"No rule leaves the parameter {', '.join(unused)} open to be given. The plan is:\n"
            f"{plan}"
        )
