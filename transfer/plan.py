"""Plans: which operation happens to which leaf, as data, and a report of what it did.

A :class:`Plan` is a list of rules (patterns -> operation). Every leaf of the target must be claimed
by exactly one rule, or by the plan's explicit default: what a plan forgets is an error, and so is
what it says twice. Plans are values: they print, compare, and go to YAML or JSON and back (see
:mod:`transfer.plan_files`).

Axis letters: P population member.
"""

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from transfer import population as populations
from transfer import surgery
from transfer.leaves import find, key_ndim, repeat
from transfer.report import Report, Row, measure
from transfer.select import Mask, PyTree, flatten, mask_of, match_paths, paths

Operations = Mapping[str, Callable[..., PyTree]]

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
        frozen: whether the leaves are meant to stay as they are in training. ``apply`` only says
            so in its report; :func:`frozen` gives the mask that ``freeze`` acts on.
        note: a word to the reader of the plan.
    """

    patterns: tuple[str, ...]
    operation: str
    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    source: str | tuple[str, ...] | None = None
    optional: bool = False
    frozen: bool = False
    note: str = ""

    def __post_init__(self):
        patterns = (self.patterns,) if isinstance(self.patterns, str) else tuple(self.patterns)
        source = tuple(self.source) if isinstance(self.source, list) else self.source
        object.__setattr__(self, "patterns", patterns)
        object.__setattr__(self, "source", source)
        object.__setattr__(self, "parameters", dict(self.parameters))
        if not patterns or not all(isinstance(pattern, str) for pattern in patterns):
            raise ValueError(
                f"A rule needs one pattern or several, as strings; the rule for "
                f"{self.operation!r} got {self.patterns!r}."
            )

    def __str__(self) -> str:
        return f"{', '.join(self.patterns)} -> {self.operation}"

    def describe(self) -> str:
        """The operation with its parameters, as in ``fraction(omega=0.2)``."""
        arguments = [f"{name}={value}" for name, value in self.parameters.items()]
        if self.source is not None:
            arguments.append(f"source={self.source}")
        return f"{self.operation}({', '.join(arguments)})" + (", frozen" if self.frozen else "")


@dataclasses.dataclass(frozen=True)
class Plan:
    """An ordered list of rules that together claim every leaf once.

    Attributes:
        rules: the rules.
        default: the operation for leaves that no rule claims (``"keep"``, ``"copy"``); with
            ``None`` such leaves are an error.
        name: what the plan is called when printed.

    >>> plan = Plan((Rule("body/**", "copy"), Rule("head/**", "fraction", {"omega": 0.5})))
    >>> print(plan)
    body/**  copy()
    head/**  fraction(omega=0.5)
    >>> tree = {"body": {"w": jnp.ones(2)}, "head": {"w": jnp.ones(2)}}
    >>> new, report = apply(plan, tree, tree)
    >>> new
    {'body': {'w': Array([1., 1.], dtype=float32)}, 'head': {'w': Array([1.5, 1.5], dtype=float32)}}
    """

    rules: tuple[Rule, ...]
    default: str | None = None
    name: str = ""

    def __post_init__(self):
        object.__setattr__(self, "rules", tuple(self.rules))

    def __str__(self) -> str:
        rows = [(", ".join(rule.patterns), rule.describe(), rule.note) for rule in self.rules]
        if self.default is not None:
            rows.append(("(all others)", f"{self.default}()", ""))
        first, second = (max((len(row[column]) for row in rows), default=0) for column in (0, 1))
        lines = [f"{a:{first}}  {b:{second}}  {c}".rstrip() for a, b, c in rows]
        return "\n".join([self.name, *lines] if self.name else lines)


def claims(plan: Plan, target: PyTree) -> dict[str, Rule]:
    """The rule that claims each leaf of a target, by path, in tree order.

    Raises:
        ValueError: a leaf claimed twice or by nobody, or a rule that is not optional and claims
            nothing.

    >>> plan = Plan((Rule("head/**", "keep"),), default="copy")
    >>> found = claims(plan, {"body": {"w": jnp.ones(2)}, "head": {"w": jnp.ones(2)}})
    >>> {path: rule.operation for path, rule in found.items()}
    {'body/w': 'copy', 'head/w': 'keep'}
    """
    names = paths(target)
    claimed: dict[str, Rule] = {}
    for rule in plan.rules:
        for path in sorted(match_paths(names, *rule.patterns, optional=rule.optional)):
            if path in claimed:
                raise ValueError(
                    f"{path} is claimed twice: by the rules '{claimed[path]}' and '{rule}'. "
                    "Exclude it from one of them with a '!' pattern."
                )
            claimed[path] = rule
    left = [path for path in names if path not in claimed]
    if left and plan.default is None:
        raise ValueError(
            f"No rule claims {len(left)} of {len(names)} leaves: {', '.join(left)}. Add a rule, or "
            "set the plan's default."
        )
    rest = Rule("**", plan.default) if left else None
    return {path: claimed.get(path, rest) for path in names}


def frozen(plan: Plan, tree: PyTree) -> Mask:
    """The mask of the leaves that the plan's rules call frozen.

    >>> plan = Plan((Rule("encoder/*", "copy", frozen=True),), default="keep")
    >>> frozen(plan, {"encoder": {"w": jnp.ones(2)}, "head": {"w": jnp.ones(2)}})
    {'encoder': {'w': True}, 'head': {'w': False}}
    """
    return mask_of(tree, (path for path, rule in claims(plan, tree).items() if rule.frozen))


def source_leaves(
    plan: Plan, target: PyTree, source: PyTree, *, operations: Operations = OPERATIONS
) -> dict[str, Any]:
    """The leaves of a source that the plan reads, as a flat ``{path: array}``.

    Sources that differ where the plan does not look (another action size) are alike in these, so
    they can be stacked; the result is a valid source for :func:`apply`. For plans of one source.

    Raises:
        ValueError: as :func:`claims`, or a leaf the plan reads that the source has not.
    """
    flat = flatten(source)
    return {
        path: find(flat, path)
        for path, rule in claims(plan, target).items()
        if "source" in _signature(rule, operations)
    }


def apply(
    plan: Plan,
    target: PyTree,
    source: PyTree = None,
    *,
    key: jax.Array | None = None,
    population: bool = False,
    operations: Operations = OPERATIONS,
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
            gets a key of its own; the report has a row of numbers for each member.
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
    before = flatten(target)
    members = populations.size(target) if population else None
    if population and key is not None and key.ndim == key_ndim(key):
        key = jax.random.split(key, members)
    rules = tuple({id(rule): rule for rule in claimed.values()}.values())
    read: dict[str, Any] = {}
    arguments = []
    result = target
    for rule in rules:
        mine = [path for path in before if claimed[path] is rule]
        signature = _signature(rule, operations)
        arguments.append(_arguments(rule, signature, parameters))
        trees = _sources(plan, rule, signature, source)
        if population:
            trees = [_repeat_shared(tree, before, mine, members) for tree in trees]
        several = "sources" in signature
        inputs = [trees] if several else trees
        if trees and not several:
            read |= {path: trees[0][path] for path in mine if path in trees[0]}
        keywords = dict(arguments[-1])
        if "key" in signature:
            if key is None:
                raise ValueError(f"The rule '{rule}' draws random numbers; give apply a key.")
            keywords |= {"key": key}
        where = mask_of(result, mine)
        result = operations[rule.operation](result, *inputs, where=where, **keywords)
    _check_all_used(plan, rules, arguments, parameters)
    rows = [
        Row(
            leaf=path,
            rule=", ".join(claimed[path].patterns),
            operation=claimed[path].operation,
            shape=leaf.shape,
            frozen=claimed[path].frozen,
            rule_number=next(n for n, rule in enumerate(rules) if rule is claimed[path]),
        )
        for path, leaf in before.items()
    ]
    return result, measure(rows, arguments, before, flatten(result), read, members=members)


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
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY and name not in ("where", "key")
    ]
    for name in rule.parameters:
        if name not in names:
            raise ValueError(
                f"The rule '{rule}' sets {name!r}; the parameters of {rule.operation} are "
                f"{', '.join(names) or 'none'}."
            )
    given = {name: parameters[name] for name in names if name in parameters} | rule.parameters
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


def _sources(
    plan: Plan, rule: Rule, signature: Mapping[str, inspect.Parameter], source: PyTree
) -> list[dict[str, Any]]:
    """The trees that a rule reads, flat: none, one, or as many as it names."""
    several = "sources" in signature
    if not several and "source" not in signature:
        return []
    if source is None:
        raise ValueError(f"The rule '{rule}' reads a source; give apply one.")
    if not any(other.source is not None for other in plan.rules):
        if several:
            raise ValueError(
                f"The rule '{rule}' reads several sources; name them in the rule, as in "
                "source=('first', 'second'), and give apply {name: tree}."
            )
        return [flatten(source)]
    if not isinstance(source, Mapping):
        raise ValueError(
            f"Rules of the plan name their sources; give apply {{name: tree}}, "
            f"got {type(source).__name__}."
        )
    if rule.source is None or isinstance(rule.source, tuple) is not several:
        wanted = "a tuple of source names" if several else "the name of one source"
        raise ValueError(
            f"The rule '{rule}' needs {wanted}, got {rule.source!r}; given are {', '.join(source)}."
        )
    names = rule.source if several else (rule.source,)
    for name in names:
        if name not in source:
            raise ValueError(
                f"The rule '{rule}' reads the source {name!r}; given are {', '.join(source)}."
            )
    return [flatten(source[name]) for name in names]


def _repeat_shared(source: dict, target: dict, names: list[str], members: int) -> dict[str, Any]:
    """The source with those named leaves repeated that all members share.

    They are the ones with one axis less than the target's.
    """
    shared = [
        path for path in names if path in source and source[path].ndim == target[path].ndim - 1
    ]
    return source | {path: repeat(source[path], members) for path in shared}
