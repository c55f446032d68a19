"""Plans: which operation happens to which leaf, as data.

A `Plan` is a list of rules (patterns -> operation). Every leaf of the target must be claimed
by exactly one rule, or by the plan's explicit default: what a plan forgets is an error, and so is
what it says twice. Plans are values: they print, compare, hash, cannot be changed, and go to YAML
or JSON and back (see `transfer.plan_files`). `transfer.apply` carries one out.
"""

import dataclasses
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from transfer import layout as layouts
from transfer.patterns import captures, match_paths
from transfer.select import Mask, PyTree, mask_of, paths


class Parameters(Mapping[str, Any]):
    """A mapping that cannot be changed, with a hash."""

    __slots__ = ("_items",)
    _items: Mapping[str, Any]

    def __init__(self, items: Mapping[str, Any]):
        object.__setattr__(self, "_items", dict(items))

    def __getitem__(self, name: str) -> Any:
        return self._items[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError("The parameters of a rule cannot be changed; make another rule.")

    def __hash__(self) -> int:
        return hash(frozenset(self._items.items()))

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, Mapping) and self._items == dict(other)

    def __repr__(self) -> str:
        return repr(self._items)

    def __reduce__(self):
        return Parameters, (self._items,)


def _value(name: str, value: Any) -> Any:
    """A parameter as a value that cannot change: lists and arrays become tuples."""
    if value is None or isinstance(value, bool | int | float | complex | str):
        return value
    if isinstance(value, jax.core.Tracer):
        raise ValueError(
            f"{name} is traced, and a plan holds values; leave it open and give it to apply."
        )
    if isinstance(value, slice):
        ends = (value.start, value.stop, *(() if value.step is None else (value.step,)))
        return ":".join("" if end is None else str(end) for end in ends)
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise ValueError(f"{name} has the key {key!r}; expected names as strings.")
        return Parameters({key: _value(f"{key!r} in {name}", value[key]) for key in value})
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        return _tuples(np.asarray(value))
    if isinstance(value, Sequence):
        return tuple(_value(name, item) for item in value)
    try:
        hash(value)
    except TypeError:
        raise ValueError(
            f"{name} cannot be part of a plan, which is a value: {value!r}. Leave it open and give "
            "it to apply."
        ) from None
    return value


def _tuples(array: np.ndarray) -> Any:
    """An array as nested tuples; 0.2 of float32 as 0.2, which is the same float32."""
    if array.ndim:
        return tuple(_tuples(item) for item in array)
    if jnp.issubdtype(array.dtype, jnp.floating) and array.dtype != np.float64:
        return float(str(array[()]))
    return array[()].item()


class Reading(NamedTuple):
    """Where a rule reads: which source (`None`: the only one) and which path (`None`: the
    target's own)."""

    name: str | None
    path: str | None


_CAPTURED = re.compile(r"(?<!\\)\{(\w+)(?::\*\*)?\}")


def _reading(text: str) -> Reading:
    text = _CAPTURED.sub(r"{\1}", text)
    if ":" in text:
        name, _, path = text.rpartition(":")
        return Reading(name or None, path or None)
    return Reading(None, text) if "/" in text or "{" in text else Reading(text, None)


@dataclasses.dataclass(frozen=True)
class Rule:
    """What happens to the leaves that some patterns select.

    Attributes:
      patterns: glob patterns, taken in order (see `transfer.select`); one may be given as
        a plain string.
      operation: the name of an operation, such as `"copy"`.
      parameters: its keyword arguments. What is left out is given to `transfer.apply` by
        name. A number may differ with depth, `{"values": [0, 0.5, 1], "over": "layer"}`: the
        values are spread evenly over what `{layer}` in the pattern stands for, in between
        linearly.
      source: where the rule reads; `None` for the same path of the only source.

        * `"teacher"`: the same path of the source of that name, where there are several;
        * `"blk/{i}/attn/{rest}"`: another path of the only source, with what `{i}` and
          `{rest}` in the pattern stand for. A path of a single part is written `":weight"`;
        * `"teacher:blk/{i}/w"`: both. A name that holds a `/` ends with `:`.

        A tuple names one source each for operations on several (`average`); for others it
        names several leaves, or a path with `*` does, that the layout's first step joins.
      optional: whether the patterns may match nothing (a head that not every agent has).
      frozen: whether the leaves are meant to stay as they are in training. `apply` only says
        so in its report; `frozen` gives the mask that `freeze` acts on.
      note: a word to the reader of the plan.
      layout: steps from the arrays that are read to the one the operation takes, see
        `transfer.layout`.

    Lists and arrays among these become tuples, so that a rule is a value that never changes.

    Raises:
      ValueError: a field of the wrong type, a captured part that no pattern has, or a layout
        with an unknown step.
    """

    patterns: tuple[str, ...]
    operation: str
    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    source: str | tuple[str, ...] | None = None
    optional: bool = False
    frozen: bool = False
    note: str = ""
    layout: tuple[Any, ...] = ()

    if TYPE_CHECKING:
        # What may be given, where the fields say what there is.
        def __init__(
            self,
            patterns: str | Sequence[str],
            operation: str,
            parameters: Mapping[str, Any] = ...,
            source: str | Sequence[str] | None = None,
            optional: bool = False,
            frozen: bool = False,
            note: str = "",
            layout: str | Mapping[str, Any] | Sequence[Any] = (),
        ) -> None: ...

    def __post_init__(self):
        patterns: Any = self.patterns
        if isinstance(patterns, str):
            patterns = (patterns,)
        if (
            not isinstance(patterns, Sequence)
            or not patterns
            or not all(isinstance(pattern, str) for pattern in patterns)
        ):
            raise ValueError(
                f"A rule needs one pattern or several, as strings; the rule for "
                f"{self.operation!r} got {self.patterns!r}."
            )
        what = f"the rule for {', '.join(patterns)}"
        for name, kind, word in (
            ("operation", str, "a name"),
            ("parameters", Mapping, "a mapping"),
            ("optional", bool, "true or false"),
            ("frozen", bool, "true or false"),
            ("note", str, "text"),
        ):
            _check_type(what, name, getattr(self, name), kind, word)
        source: Any = self.source
        if isinstance(source, list):
            source = tuple(source)
        for text in source if isinstance(source, tuple) else (source,):
            if text is not None or source == ():
                _check_type(what, "source", text, str, "a name, or several")
        layout: Any = self.layout
        if isinstance(layout, str | Mapping):
            layout = (layout,)
        layouts.steps(layout)
        object.__setattr__(self, "patterns", tuple(patterns))
        object.__setattr__(self, "source", source)
        object.__setattr__(self, "layout", _value(f"layout of {what}", layout))
        object.__setattr__(self, "parameters", _value(f"a parameter of {what}", self.parameters))
        self._check_captures()

    def _check_captures(self) -> None:
        used = set(layouts.captured_names(self.layout))
        for _, path in self.readings:
            used |= set(_CAPTURED.findall(path or ""))
        used |= {over for _, over in self._gradients()}
        for pattern in self.patterns:
            if pattern.startswith("!"):
                continue
            if missing := sorted(used - set(_CAPTURED.findall(pattern))):
                raise ValueError(
                    f"The rule '{self}' uses {{{missing[0]}}}, which its pattern {pattern!r} does "
                    "not capture."
                )

    def _gradients(self) -> list[tuple[str, str]]:
        return [(name, p["over"]) for name, p in self.parameters.items() if is_gradient(p)]

    @property
    def readings(self) -> tuple[Reading, ...]:
        """What `source` says, entry by entry; one empty entry where it says nothing."""
        if self.source is None:
            return (Reading(None, None),)
        return tuple(map(_reading, (self.source,) if isinstance(self.source, str) else self.source))

    def captured(self, path: str) -> dict[str, str]:
        """What the captured parts of the rule's patterns stand for in a path that it claims."""
        for pattern in self.patterns:
            if not pattern.startswith("!") and (found := captures(pattern, path)) is not None:
                return found
        return {}

    def __str__(self) -> str:
        return f"{', '.join(self.patterns)} -> {self.operation}"

    def describe(self) -> str:
        """The operation with its parameters, as in `fraction(omega=0.2)`."""
        arguments = [f"{name}={value}" for name, value in self.parameters.items()]
        if self.source is not None:
            arguments.append(f"source={self.source}")
        if self.layout:
            arguments.append(f"layout={list(self.layout)}")
        return f"{self.operation}({', '.join(arguments)})" + (", frozen" if self.frozen else "")


def is_gradient(value: Any) -> bool:
    """Whether a parameter is `{"values": ..., "over": name}`."""
    return isinstance(value, Mapping) and set(value) == {"values", "over"}


def _check_type(what: str, name: str, value: Any, kind: Any, word: str) -> None:
    if not isinstance(value, kind):
        raise ValueError(
            f"{name} of {what} is {value!r} ({type(value).__name__}); expected {word}."
        )


@dataclasses.dataclass(frozen=True)
class Plan:
    """An ordered list of rules that together claim every leaf once.

    Attributes:
      rules: the rules.
      default: the operation for leaves that no rule claims (`"keep"`, `"copy"`); with
        `None` such leaves are an error.
      name: what the plan is called when printed.

    >>> plan = Plan((Rule("body/**", "copy"), Rule("head/**", "fraction", {"omega": 0.5})))
    >>> print(plan)
    body/**  copy()
    head/**  fraction(omega=0.5)
    >>> tree = {"body": {"w": jnp.ones(2)}, "head": {"w": jnp.ones(2)}}
    >>> new, report = transfer.apply(plan, tree, tree)
    >>> new
    {'body': {'w': Array([1., 1.], dtype=float32)}, 'head': {'w': Array([1.5, 1.5], dtype=float32)}}
    """

    rules: tuple[Rule, ...]
    default: str | None = None
    name: str = ""

    def __post_init__(self):
        if isinstance(self.rules, Rule):
            raise ValueError("A plan takes a list of rules, got one rule.")
        object.__setattr__(self, "rules", tuple(self.rules))
        for rule in self.rules:
            _check_type("a plan", "a rule", rule, Rule, "a Rule")
        _check_type("a plan", "default", self.default, str | None, "the name of an operation")
        _check_type("a plan", "name", self.name, str, "text")

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
    if left and plan.default is not None:
        claimed |= dict.fromkeys(left, Rule("**", plan.default))
    return {path: claimed[path] for path in names}


def frozen(plan: Plan, tree: PyTree) -> Mask:
    """The mask of the leaves that the plan's rules call frozen.

    >>> plan = Plan((Rule("encoder/*", "copy", frozen=True),), default="keep")
    >>> frozen(plan, {"encoder": {"w": jnp.ones(2)}, "head": {"w": jnp.ones(2)}})
    {'encoder': {'w': True}, 'head': {'w': False}}
    """
    return mask_of(tree, (path for path, rule in claims(plan, tree).items() if rule.frozen))


Operations = Mapping[str, Callable[..., PyTree]]
