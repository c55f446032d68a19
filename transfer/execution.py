"""Plans carried out: on a tree, on shapes alone (a dry run), or leaf by leaf from a file.

Axis letters: P population member.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from transfer import merging, surgery, task_vectors
from transfer import population as populations
from transfer.leaves import check_key, find, key_ndim
from transfer.patterns import suggest
from transfer.plan import Operations, Plan, Rule, claims, is_gradient
from transfer.reading import Once, View, flat_sources, natural, reads, source_places
from transfer.report import Report, Row, measure_leaves, summarise
from transfer.select import Leaves, PyTree, flatten, mask_of, unflatten
from transfer.values import numbers

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
        task_vectors.task_arithmetic,
        task_vectors.ties,
        task_vectors.dare,
        task_vectors.breadcrumbs,
        merging.model_stock,
        merging.karcher_mean,
    )
}


def source_leaves(
    plan: Plan, target: PyTree, source: PyTree, *, operations: Operations = OPERATIONS
) -> dict[str, Any]:
    """The leaves of a source that the plan reads, as a flat `{path: array}`.

    Sources that differ where the plan does not look (another action size) are alike in these, so
    they can be stacked; the result is a valid source for `apply`. For plans of one source.

    Raises:
      ValueError: as `transfer.claims`, or a leaf the plan reads that the source has not.
    """
    flat = flatten(source)
    names: dict[str, None] = {}
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
        (`jax.ShapeDtypeStruct`, as from `jax.eval_shape`), this is a dry run: everything
        but values is checked, and the new tree has shapes too.
      source: the tree that knowledge comes from; where rules name their sources, a mapping
        `{name: tree}`. A file from `transfer.open_file` is read leaf by leaf.
      key: one PRNG key, for the operations that draw. Leaves draw independently.
      population: whether the target's leaves are stacked on a leading axis P. Source leaves may
        be stacked too or shared by all members; parameters may be scalars or [P]; each member
        gets a key of its own; the report has a row of numbers for each member.
      strict: whether a leaf of the source that no rule reads is an error. Otherwise it is listed
        in the report's `unread`.
      measure: whether the report has norms and cosines, which take a pass over all leaves.
      operations: what the names in the plan mean; extend `OPERATIONS` with your own.
      **parameters: values for what the rules leave open, such as `omega=0.2`; they go to
        every rule whose operation has a parameter of this name that the plan does not set.
        A value may be a mapping `{path, branch or pattern: number}` or a tree, which gives
        each leaf its own, traced and differentiable too.

    Returns:
      The new tree and a `Report`. Under `vmap` both get a leading axis.

    Raises:
      ValueError: as `transfer.claims`; or a parameter, key or source that is missing or
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

    As `apply`, but for two things. Each operation sees one leaf at a time, as
    `{path: array}`. And the target may have shapes in place of arrays (`jax.ShapeDtypeStruct`)
    where the operation does not read the target's values: `copy`, `take`, `crop`, `pad`
    with a `fill`, `reinitialise` and `average`. An array is made for each, on the devices
    that the shape's `sharding` names, so that neither a whole target nor a whole source exists.

    Raises:
      ValueError: as `apply`; or a shape of the target whose operation reads its values.

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


def _prepare(
    plan: Plan,
    target: PyTree,
    source: PyTree,
    key: jax.Array | None,
    population: bool,
    strict: bool,
    *,
    operations: Operations,
    given: Mapping[str, Any],
) -> _Work:
    """A plan with all that its rules read and need; every error that needs no operation."""
    claimed = claims(plan, target)
    before = flatten(target)
    members = populations.size(target) if population else None
    if key is not None:
        key = check_key(key)
        if members is not None and key.ndim == key_ndim(key):
            key = jax.random.split(key, members)
    sources = flat_sources(plan, source)
    rules = tuple({id(rule): rule for rule in claimed.values()}.values())
    work, arguments = [], []
    read: dict[str | None, set[str]] = {name: set() for name in sources}
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
        for name, tree, places in reads(rule, signature, mine, sources):
            read[name] |= {place for found in places.values() for place in found}
            views.append(View(rule, tree, places, before, members))
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
        jax.tree.map(lambda view: view.shapes, step.inputs, is_leaf=lambda x: isinstance(x, View))
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
                lambda view, path=path, held=held: Once(view, path, held),
                step.inputs,
                is_leaf=lambda x: isinstance(x, View),
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


def _renamed(rule, path, sources, operations) -> str | None:
    """What a leaf is made from, where that is not the leaf of the same path."""
    signature = _signature(rule, operations)
    if "source" not in signature or not any(reading.path for reading in rule.readings):
        return None
    ((_, _, places),) = reads(rule, signature, (path,), sources)
    return ", ".join(places[path])


# --- parameters ------------------------------------------------------------------------------


class _PerLeaf(dict):
    """A number for each leaf of a rule, by path."""


def _resolved(rule, name, value, mine, before, operation) -> Any:
    """A parameter that differs between leaves as `{path: number}`; any other as it is."""
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
    """The number of each leaf where `values` are spread over a captured part."""
    captured = {path: rule.captured(path) for path in mine}
    if any(value["over"] not in parts for parts in captured.values()):
        raise ValueError(
            f"{name} of the rule '{rule}' is spread over {{{value['over']}}}, which its pattern "
            "does not capture."
        )
    depths = {path: parts[value["over"]] for path, parts in captured.items()}
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
