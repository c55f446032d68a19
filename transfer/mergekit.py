"""Plans of merges as mergekit writes them in YAML (https://github.com/arcee-ai/mergekit).

Read are the methods that both have: `linear`, `slerp`, `task_arithmetic`, `ties`,
`dare_linear`, `dare_ties`, `breadcrumbs`, `breadcrumbs_ties`, `model_stock` and
`karcher`; their parameters as numbers, as gradients over layers ([0, 0.5, 1]), and by filter.
What a configuration says beyond that is an error, so that nothing is left out in silence.
"""

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from transfer.plan import Plan, Rule
from transfer.plan_files import read_data

# mergekit's method: ours, the settings that make them one, and whether weights are normalised.
_METHODS: Mapping[str, tuple[str, dict[str, Any], bool | None]] = {
    "linear": ("average", {}, True),
    "slerp": ("slerp", {}, None),
    "task_arithmetic": ("task_arithmetic", {}, False),
    "ties": ("ties", {}, True),
    "dare_linear": ("dare", {}, False),
    "dare_ties": ("dare", {"elect_sign": True}, False),
    "breadcrumbs": ("breadcrumbs", {}, False),
    "breadcrumbs_ties": ("breadcrumbs", {"elect_sign": True}, False),
    "model_stock": ("model_stock", {}, None),
    "karcher": ("karcher_mean", {}, None),
}
# Their parameters by our operation: theirs -> (ours, one for each model, default).
_WEIGHTS = {"weight": ("weights", True, None)}
_VECTORS = _WEIGHTS | {"lambda": ("scale", False, 1.0)}
_PARAMETERS: Mapping[str, Mapping[str, tuple[str, bool, float | None]]] = {
    "average": _WEIGHTS,
    "slerp": {"t": ("weight", False, None)},
    "task_arithmetic": _VECTORS,
    "ties": _VECTORS | {"density": ("density", True, 1.0)},
    "dare": _VECTORS | {"density": ("density", True, 1.0)},
    "breadcrumbs": _VECTORS
    | {"density": ("density", True, 1.0), "gamma": ("outliers", True, 0.01)},
    "model_stock": {},
    "karcher_mean": {},
}
# What says nothing of the merged numbers, or of how they are computed.
_IGNORED = ("dtype", "out_dtype", "chat_template", "name")
_IGNORED_PARAMETERS = ("int8_mask", "filter_wise")


def read_mergekit(path: str | os.PathLike, *, layers: str = "layers") -> Plan:
    """The plan that a mergekit configuration describes.

    The plan's target is the base model (for `linear` and `karcher` any tree of its shape), and
    its sources are called by the models' names in the file:
    `apply(plan, base, {"org/model-a": a, "org/model-b": b})`. `dare` asks for a key.

    As in mergekit a gradient is spread over the layers, which here are what stands behind
    `layers` in a path; leaves outside of them get its first value if their path holds "embed",
    else its last. A filter selects the leaves whose path holds it, a dot in it being a `/`.
    Unlike mergekit, a filter that selects nothing is an error, and DARE rescales as its paper does,
    by 1 / density.

    Args:
      path: a `.yaml`, `.yml` or `.json` file.
      layers: the part of a path that the number of a layer follows.

    Raises:
      ValueError: as `transfer.read_plan`; or a method, parameter or entry that is not read.
    """
    data = read_data(path)
    try:
        return from_mergekit(data, layers=layers)
    except ValueError as error:
        raise ValueError(f"{path} holds no merge that can be read: {error}") from error


def from_mergekit(data: Any, *, layers: str = "layers") -> Plan:
    """The plan of a configuration that is loaded already; see `read_mergekit`.

    >>> plan = from_mergekit({
    ...     "merge_method": "slerp", "base_model": "a", "models": [{"model": "a"}, {"model": "b"}],
    ...     "parameters": {"t": 0.5}})
    >>> print(plan)
    mergekit slerp
    **  slerp(weight=0.5, source=b:)
    """
    if not isinstance(data, Mapping):
        raise ValueError(f"expected a mapping, got {data!r}")
    method: Any = data.get("merge_method")
    if method not in _METHODS:
        raise ValueError(f"the method {method!r} is not read; those are {', '.join(_METHODS)}")
    known = ("merge_method", "base_model", "models", "slices", "parameters", *_IGNORED)
    if unknown := [name for name in data if name not in known]:
        raise ValueError(f"the entry {unknown[0]!r} is not read; those are {', '.join(known)}")
    operation, settings, normalised = _METHODS[method]
    models, shared = _models(data)
    base = data.get("base_model")
    if operation not in ("average", "karcher_mean"):
        if base is None:
            raise ValueError(f"{method} needs a base_model")
        models = {name: own for name, own in models.items() if name != base}
    if not models or (operation == "slerp" and len(models) != 1):
        raise ValueError(f"{method} merges {len(models)} models beside its base")
    settings = dict(settings)
    _check_parameters(method, operation, shared, models, normalised, settings)
    source = tuple(f"{name}:" for name in models)
    groups = _groups(operation, shared, models)
    gradient = any(_is_gradient(value) for group in groups for value in _all(group[1]))
    rules: list[Rule] = []
    earlier: list[str] = []
    for filter_, values in groups:
        holds = [] if filter_ is None else [f"*{part}*" for part in filter_.split(".")]
        middle = "/".join(["**", *holds, "**"]) if holds else "**"
        without = tuple(f"!{pattern}" for pattern in earlier)
        inside = f"**/{layers}/{{layer}}/{middle}"
        regions: list[tuple[tuple[str, ...], Any, bool]] = [((middle,), None, False)]
        if gradient:
            outside = f"!**/{layers}/*/**"
            first = "**/*embed*/**"
            regions = [
                ((inside,), "layer", False),
                ((middle, outside, f"!{first}"), 1.0, True),
            ]
            if not holds:
                regions.append(((first, outside), 0.0, True))
        for patterns, place, optional in regions:
            rules.append(
                Rule(
                    (*patterns, *without),
                    operation,
                    settings
                    | {
                        name: _at(value, place, len(models) if each else None)
                        for name, (value, each) in values.items()
                    },
                    source=source[0] if operation == "slerp" else source,
                    optional=optional,
                    note="" if filter_ is None else f"filter {filter_}",
                )
            )
        if holds:
            earlier.append(middle)
    return Plan(tuple(rules), name=f"mergekit {method}")


def _models(data: Mapping[str, Any]) -> tuple[dict[str, Mapping[str, Any]], Mapping[str, Any]]:
    """The parameters of each model by name, and those of all."""
    shared = data.get("parameters") or {}
    entries, layers = data.get("models"), False
    if entries is None:
        slices = data.get("slices")
        if not isinstance(slices, Sequence) or len(slices) != 1:
            raise ValueError("of slices, only a single one is read, which takes whole models")
        if unknown := set(slices[0]) - {"sources", "parameters"}:
            raise ValueError(f"the entry {sorted(unknown)[0]!r} of a slice is not read")
        entries, layers = slices[0].get("sources"), True
        shared = {**shared, **(slices[0].get("parameters") or {})}
        if len({tuple(entry.get("layer_range", ())) for entry in entries}) != 1:
            raise ValueError("the slice takes different layers of its models")
    if not isinstance(entries, Sequence) or isinstance(entries, str) or not entries:
        raise ValueError(f"expected a list of models, got {entries!r}")
    found = {}
    for entry in entries:
        if not isinstance(entry, Mapping) or not isinstance(entry.get("model"), str):
            raise ValueError(f"expected a model with its name, got {entry!r}")
        allowed = {"model", "parameters"} | ({"layer_range"} if layers else set())
        if unknown := set(entry) - allowed:
            raise ValueError(f"the entry {sorted(unknown)[0]!r} of a model is not read")
        if entry["model"] in found:
            raise ValueError(f"the model {entry['model']} comes twice")
        found[entry["model"]] = entry.get("parameters") or {}
    return found, shared


def _check_parameters(method, operation, shared, models, normalised, settings) -> None:
    """Raise for a parameter that is not read; and the settings that are no numbers."""
    known = {*_PARAMETERS[operation], *_IGNORED_PARAMETERS}
    if normalised is not None:
        known.add("normalize")
        value = shared.get("normalize", normalised)
        if value not in (True, False, 0, 1):
            raise ValueError(f"normalize is {value!r}; expected true or false")
        settings["normalise"] = bool(value)
    if operation == "karcher_mean":
        known |= {"max_iter", "tol"}
        settings["iterations"] = int(shared.get("max_iter", 10))
    if operation == "dare":
        known.add("rescale")
        if not shared.get("rescale", True):
            raise ValueError("dare without rescale is not read")
    for parameters in (shared, *models.values()):
        if unknown := [name for name in parameters if name not in known]:
            raise ValueError(f"the parameter {unknown[0]!r} of {method} is not read")


def _groups(operation, shared, models) -> list[tuple[str | None, dict[str, tuple[Any, bool]]]]:
    """For each filter, and last for all other leaves, the value of each of our parameters."""
    settings = [shared, *models.values()]
    theirs = _PARAMETERS[operation]
    filters: list[str | None] = []
    for parameters in settings:
        for name in theirs:
            for condition in _conditions(parameters.get(name)):
                if condition[0] is not None and condition[0] not in filters:
                    filters.append(condition[0])
    groups = []
    for filter_ in (*filters, None):
        values = {}
        for name, (ours, each, default) in theirs.items():
            if not each:
                value = _first(name, filter_, default, shared)
                values[ours] = (value, False)
                continue
            values[ours] = (
                [_first(name, filter_, default, own, shared) for own in models.values()],
                True,
            )
        groups.append((filter_, values))
    return groups


def _conditions(setting: Any) -> list[tuple[str | None, Any]]:
    """A setting as (filter, value), the first that fits being the one."""
    if isinstance(setting, Mapping):
        setting = [setting]
    if setting is None:
        return []
    if isinstance(setting, Sequence) and any(isinstance(item, Mapping) for item in setting):
        found = []
        for item in setting:
            if not isinstance(item, Mapping) or not {"value"} <= set(item) <= {"value", "filter"}:
                raise ValueError(f"expected a value, with a filter or without, got {item!r}")
            filter_ = item.get("filter")
            found.append((None if filter_ == "*" else filter_, item["value"]))
        return found
    return [(None, setting)]


def _first(name: str, filter_: str | None, default: float | None, *places: Mapping) -> Any:
    for parameters in places:
        for wanted, value in _conditions(parameters.get(name)):
            if wanted is None or (filter_ is not None and wanted in filter_):
                return value
    if default is None:
        raise ValueError(f"the parameter {name!r} is not given for all models and leaves")
    return default


def _is_gradient(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _all(values: Mapping[str, tuple[Any, bool]]) -> list[Any]:
    return [item for value, each in values.values() for item in (value if each else [value])]


def _at(value: Any, place: str | float | None, models: int | None) -> Any:
    """A value inside the layers (a gradient, if it is one) or at one end of them."""
    parts = value if models else [value]
    if not any(map(_is_gradient, parts)):
        return tuple(parts) if models else value
    lists = [list(part) if _is_gradient(part) else [part] for part in parts]
    # On a grid that holds the knots of all.
    count = math.lcm(*(max(1, len(part) - 1) for part in lists))
    grid = np.linspace(0, 1, count + 1)
    columns = [
        np.interp(grid, np.linspace(0, 1, len(part)), part)
        if len(part) > 1
        else np.full(count + 1, float(part[0]))
        for part in lists
    ]
    rows = np.stack(columns, axis=1).tolist() if models else columns[0].tolist()
    if place == "layer":
        return {"values": rows, "over": place}
    return rows[0] if place == 0 else rows[-1]
