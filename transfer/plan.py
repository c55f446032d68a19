"""Plans: which operation happens to which leaf, as data, and a report of what it did.

A :class:`Plan` is a list of rules (patterns -> operation). Every leaf of the target must be claimed
by exactly one rule, or by the plan's explicit default: what a plan forgets is an error, and so is
what it says twice. Plans are values: they print, compare, and go to YAML or JSON and back.

Axis letters: P population member.
"""

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from transfer import leaves as leaf_tools
from transfer import population as populations
from transfer import surgery
from transfer.report import Report, Row, measure
from transfer.select import PyTree, flatten, mask_of, match_paths, paths

OPERATIONS: Mapping[str, Callable[..., PyTree]] = {
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
        surgery.average,
    )
}


@dataclasses.dataclass(frozen=True)
class Rule:
    """What happens to the leaves that some patterns select.

    Attributes:
        patterns: glob patterns, taken in order (see :func:`transfer.select`); one may be given as
            a plain string.
        operation: the name of an operation, such as ``"copy"``.
        parameters: its keyword arguments. What is left out is given to :func:`apply` by name.
        source: which source the rule reads where there are several, by name; a tuple of names for
            ``average``. ``None`` where there is one source.
        optional: whether the patterns may match nothing (a head that not every agent has).
        note: a word to the reader of the plan.
    """

    patterns: tuple[str, ...]
    operation: str
    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    source: str | tuple[str, ...] | None = None
    optional: bool = False
    note: str = ""

    def __post_init__(self):
        as_tuple = lambda x: x if x is None or isinstance(x, str) else tuple(x)  # noqa: E731
        patterns = (self.patterns,) if isinstance(self.patterns, str) else tuple(self.patterns)
        object.__setattr__(self, "patterns", patterns)
        object.__setattr__(self, "source", as_tuple(self.source))
        object.__setattr__(self, "parameters", dict(self.parameters))
        if not patterns:
            raise ValueError(f"A rule with operation {self.operation!r} has no pattern.")

    def __str__(self) -> str:
        return ", ".join(self.patterns)

    def describe(self) -> str:
        """The operation with its parameters, as in ``fraction(omega=0.2)``."""
        arguments = [f"{name}={value}" for name, value in self.parameters.items()]
        if self.source is not None:
            arguments.append(f"source={self.source}")
        return f"{self.operation}({', '.join(arguments)})"


@dataclasses.dataclass(frozen=True)
class Plan:
    """An ordered list of rules that together claim every leaf once.

    Attributes:
        rules: the rules.
        default: a rule's operation for leaves that no rule claims (``"keep"``, ``"copy"``); with
            ``None`` such leaves are an error.
        name: what the plan is called when printed.

    >>> plan = Plan((Rule("body/**", "copy"), Rule("head/**", "fraction", {"omega": 0.2})))
    >>> print(plan)
    body/**  copy()
    head/**  fraction(omega=0.2)
    >>> tree = {"body": {"w": jnp.ones(2)}, "head": {"w": jnp.ones(2)}}
    >>> new, report = apply(plan, tree, tree)
    >>> new
    {'body': {'w': Array([1., 1.], dtype=float32)}, 'head': {'w': Array([1.2, 1.2], dtype=float32)}}
    """

    rules: tuple[Rule, ...]
    default: str | None = None
    name: str = ""

    def __post_init__(self):
        object.__setattr__(self, "rules", tuple(self.rules))

    def __str__(self) -> str:
        rows = [(str(rule), rule.describe(), rule.note) for rule in self.rules]
        if self.default is not None:
            rows.append(("(all others)", f"{self.default}()", ""))
        widths = [max((len(row[column]) for row in rows), default=0) for column in range(2)]
        lines = [f"{row[0]:{widths[0]}}  {row[1]:{widths[1]}}  {row[2]}".rstrip() for row in rows]
        return "\n".join([self.name, *lines] if self.name else lines)

    def to_dict(self) -> dict[str, Any]:
        """The plan as plain lists, dictionaries, strings and numbers, for JSON or YAML.

        Raises:
            ValueError: a parameter that is not data, such as a function.
        """
        result: dict[str, Any] = {"name": self.name} if self.name else {}
        result["rules"] = [_rule_to_dict(rule) for rule in self.rules]
        if self.default is not None:
            result["default"] = self.default
        return result

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "Plan":
        """The plan that :meth:`to_dict` wrote.

        Raises:
            ValueError: an entry that is not known or is missing.
        """
        _only(data, "a plan", required=("rules",), optional=("default", "name"))
        rules = []
        for entry in data["rules"]:
            _only(
                entry,
                "a rule",
                required=("patterns", "operation"),
                optional=("parameters", "source", "optional", "note"),
            )
            rules.append(Rule(**entry))
        return cls(tuple(rules), default=data.get("default"), name=data.get("name", ""))


def _rule_to_dict(rule: Rule) -> dict[str, Any]:
    result: dict[str, Any] = {"patterns": list(rule.patterns), "operation": rule.operation}
    if rule.parameters:
        result["parameters"] = {
            name: _plain(f"parameter {name!r} of {rule.operation}", value)
            for name, value in rule.parameters.items()
        }
    if rule.source is not None:
        result["source"] = rule.source if isinstance(rule.source, str) else list(rule.source)
    if rule.optional:
        result["optional"] = True
    if rule.note:
        result["note"] = rule.note
    return result


def _plain(name: str, value: Any) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, slice) and value.step is None:
        ends = ["" if end is None else str(end) for end in (value.start, value.stop)]
        return ":".join(ends)
    if isinstance(value, Mapping):
        return {key: _plain(name, item) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [_plain(name, item) for item in value]
    if hasattr(value, "tolist") and not isinstance(value, jax.core.Tracer):
        return value.tolist()
    raise ValueError(f"{name} cannot be written as data: {value!r}. Give it by name, or to apply.")


def _only(data: Any, what: str, *, required: Sequence[str], optional: Sequence[str]) -> None:
    if not isinstance(data, Mapping):
        raise ValueError(f"Expected {what} as a mapping, got {data!r}.")
    missing = [name for name in required if name not in data]
    unknown = [name for name in data if name not in (*required, *optional)]
    if missing or unknown:
        raise ValueError(
            f"Expected {what} with {', '.join(required)} and perhaps {', '.join(optional)}; "
            f"missing: {missing}, unknown: {unknown}."
        )


def claims(plan: Plan, target: PyTree) -> dict[str, Rule]:
    """The rule that claims each leaf of a target, by path, in tree order.

    Raises:
        ValueError: a leaf claimed twice or by nobody, or a rule that is not optional and claims
            nothing.
    """
    names = paths(target)
    claimed: dict[str, Rule] = {}
    for rule in plan.rules:
        for path in _rule_paths(rule, names):
            if path in claimed:
                raise ValueError(
                    f"{path} is claimed twice: by the rule {claimed[path]} -> "
                    f"{claimed[path].operation} and by the rule {rule} -> {rule.operation}. "
                    "Exclude it from one of them with a '!' pattern."
                )
            claimed[path] = rule
    left = [path for path in names if path not in claimed]
    if left and plan.default is None:
        raise ValueError(
            f"No rule claims {len(left)} of {len(names)} leaves: {', '.join(left)}. Add a rule, or "
            "set the plan's default."
        )
    rest = Rule("**", plan.default, note="default") if plan.default is not None else None
    return {path: claimed.get(path, rest) for path in names}


def _rule_paths(rule: Rule, names: Sequence[str]) -> frozenset[str]:
    if not rule.optional:
        return match_paths(names, *rule.patterns)
    try:
        return match_paths(names, *rule.patterns)
    except ValueError:
        return frozenset()


def _find_operation(rule: Rule, operations: Mapping[str, Callable]) -> tuple[Callable, dict]:
    if rule.operation not in operations:
        raise ValueError(
            f"The rule {rule} names the operation {rule.operation!r}; expected one of "
            f"{', '.join(operations)}."
        )
    operation = operations[rule.operation]
    return operation, dict(inspect.signature(operation).parameters)


def _reads_source(parameters: dict) -> bool:
    return bool({"source", "sources"} & set(parameters))


def source_leaves(
    plan: Plan,
    target: PyTree,
    source: PyTree,
    *,
    operations: Mapping[str, Callable[..., PyTree]] = OPERATIONS,
) -> dict[str, Any]:
    """The leaves of a source that the plan reads, as a flat ``{path: array}``.

    Sources that differ where the plan does not look (another action size) are alike in these, so
    they can be stacked; the result is a valid source for :func:`apply`.

    Raises:
        ValueError: as :func:`claims`, or a leaf the plan reads that the source has not.
    """
    flat = flatten(source)
    result = {}
    for path, rule in claims(plan, target).items():
        if _reads_source(_find_operation(rule, operations)[1]):
            result[path] = leaf_tools.find(flat, path)
    return result


def apply(
    plan: Plan,
    target: PyTree,
    source: PyTree = None,
    *,
    key: jax.Array | None = None,
    population: bool = False,
    operations: Mapping[str, Callable[..., PyTree]] = OPERATIONS,
    **parameters: Any,
) -> tuple[PyTree, Report]:
    """Carry out a plan.

    Args:
        plan: the plan.
        target: the tree to change; never altered.
        source: the tree that knowledge comes from; where rules name their sources, a mapping
            ``{name: tree}``.
        key: one PRNG key, for the operations that draw. Leaves draw independently.
        population: whether the target's leaves are stacked on a leading axis P. Source leaves may
            be stacked too or shared by all members; parameters may be scalars or [P]; each member
            gets a key of its own; the report has one column per member.
        operations: what the names in the plan mean; extend ``OPERATIONS`` with your own.
        **parameters: values for what the rules leave open, such as ``omega=0.2``; they go to
            every rule whose operation has a parameter of this name that the plan does not set.

    Returns:
        The new tree and a :class:`Report`. Under ``vmap`` both get a leading axis.

    Raises:
        ValueError: as :func:`claims`; or a parameter, key or source that is missing or unused; or
            as the operations.
    """
    claimed = claims(plan, target)
    leaves = flatten(target)
    members = populations.size(target) if population else None
    if members is not None and key is not None and key.ndim == leaf_tools.key_ndim(key):
        key = jax.random.split(key, members)
    sources = _Sources(plan, source, leaves if population else None, members)

    used: set[str] = set()
    result = target
    rows, bound = [], []
    groups: dict[int, list[str]] = {}
    for path, rule in claimed.items():
        groups.setdefault(id(rule), []).append(path)
    by_id = {id(rule): rule for rule in claimed.values()}
    read: dict[str, Any] = {}
    for identity, claimed_paths in groups.items():
        rule = by_id[identity]
        operation, signature = _find_operation(rule, operations)
        arguments = _arguments(rule, signature, parameters, key)
        used |= set(arguments) - set(rule.parameters)
        positional = [result]
        if _reads_source(signature):
            trees = sources.of(rule, several="sources" in signature)
            positional.append(trees)
            if "source" in signature:
                read.update({path: trees[path] for path in claimed_paths if path in trees})
        where = mask_of(result, claimed_paths)
        result = operation(*positional, where=where, **arguments)
        shown = {name: value for name, value in arguments.items() if name != "key"}
        rows += [
            (path, Row(path, str(rule), rule.operation, leaves[path].shape, len(bound)))
            for path in claimed_paths
        ]
        bound.append(shown)
    unused = sorted(set(parameters) - used)
    if unused:
        raise ValueError(
            f"No rule of the plan has an open parameter {', '.join(unused)}; the plan is:\n{plan}"
        )
    order = {path: index for index, path in enumerate(leaves)}
    rows = [row for _, row in sorted(rows, key=lambda item: order[item[0]])]
    return result, measure(rows, bound, leaves, flatten(result), read, members=members)


def _arguments(rule: Rule, signature: dict, parameters: Mapping[str, Any], key: Any) -> dict:
    """The keyword arguments of a rule's operation: from the plan, then from the caller."""
    names = [
        name
        for name, parameter in signature.items()
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY and name not in ("where", "key")
    ]
    for name in rule.parameters:
        if name not in names:
            raise ValueError(
                f"The rule {rule} sets {name!r}; {rule.operation} has "
                f"{', '.join(names) or 'no parameters'}."
            )
    arguments = {name: parameters[name] for name in names if name in parameters}
    arguments |= rule.parameters
    if "key" in signature:
        if key is None:
            raise ValueError(f"The rule {rule} -> {rule.operation} draws; give apply a key.")
        arguments["key"] = key
    for name in names:
        if name not in arguments and signature[name].default is inspect.Parameter.empty:
            raise ValueError(
                f"The rule {rule} leaves {name!r} of {rule.operation} open; set it in the plan or "
                f"give apply {name}=..."
            )
    return arguments


class _Sources:
    """The flat source each rule reads; shared leaves repeated where the target is a population."""

    def __init__(self, plan: Plan, source: PyTree, stacked: dict | None, members: int | None):
        self._named = any(rule.source is not None for rule in plan.rules)
        self._source, self._stacked, self._members = source, stacked, members
        if self._named and not isinstance(source, Mapping):
            raise ValueError("Rules of the plan name their sources; give apply {name: tree}.")

    def of(self, rule: Rule, *, several: bool) -> Any:
        if self._source is None:
            raise ValueError(f"The rule {rule} -> {rule.operation} needs a source, got none.")
        if several:
            names = rule.source
            if not isinstance(names, tuple):
                raise ValueError(
                    f"The rule {rule} -> {rule.operation} reads several sources; name them in "
                    "Rule(..., source=(name, name))."
                )
            return [self._flat(rule, self._lookup(rule, name)) for name in names]
        if isinstance(rule.source, tuple):
            raise ValueError(
                f"The rule {rule} -> {rule.operation} reads one source, got {rule.source}."
            )
        if self._named and rule.source is None:
            raise ValueError(
                f"The rule {rule} -> {rule.operation} names no source, others do; name one of "
                f"{', '.join(self._source)}."
            )
        tree = self._lookup(rule, rule.source) if self._named else self._source
        return self._flat(rule, tree)

    def _lookup(self, rule: Rule, name: str) -> PyTree:
        if name not in self._source:
            raise ValueError(
                f"The rule {rule} reads the source {name!r}; given are {', '.join(self._source)}."
            )
        return self._source[name]

    def _flat(self, rule: Rule, tree: PyTree) -> dict[str, Any]:
        flat = flatten(tree)
        if self._stacked is None:
            return flat
        return {
            path: leaf_tools.repeat(leaf, self._members)
            if path in self._stacked and leaf.ndim == self._stacked[path].ndim - 1
            else leaf
            for path, leaf in flat.items()
        }
