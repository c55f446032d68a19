"""Plans as data: plain dictionaries, and JSON or YAML files, both ways.

Reading builds strings, numbers, lists and mappings only: a file cannot execute code, and names an
operation by its name in ``OPERATIONS``.
"""

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import yaml

from transfer.plan import Plan, Rule

_RULE_FIELDS = tuple(field.name for field in dataclasses.fields(Rule))


def to_dict(plan: Plan) -> dict[str, Any]:
    """A plan as plain lists, dictionaries, strings and numbers.

    Raises:
        ValueError: a parameter that is not data, such as a function or a traced array.

    >>> to_dict(Plan((Rule("head/*", "fraction", {"omega": 0.2}),), default="copy"))
    {'rules': [{'patterns': ['head/*'], 'operation': 'fraction', 'parameters': {'omega': 0.2}}], \
'default': 'copy'}
    """
    result: dict[str, Any] = {"name": plan.name} if plan.name else {}
    result["rules"] = [_rule_to_dict(rule) for rule in plan.rules]
    if plan.default is not None:
        result["default"] = plan.default
    return result


def _rule_to_dict(rule: Rule) -> dict[str, Any]:
    plain = Rule(rule.patterns, rule.operation)
    entries = {name: getattr(rule, name) for name in _RULE_FIELDS}
    return {
        name: _plain(f"{name} of the rule '{rule}'", value)
        for name, value in entries.items()
        if name in ("patterns", "operation") or value != getattr(plain, name)
    }


def _plain(name: str, value: Any) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, slice) and value.step is None:
        return ":".join("" if end is None else str(end) for end in (value.start, value.stop))
    if isinstance(value, Mapping):
        return {key: _plain(f"{key!r} in {name}", item) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [_plain(name, item) for item in value]
    if hasattr(value, "tolist") and not isinstance(value, jax.core.Tracer):
        return value.tolist()
    raise ValueError(
        f"{name} cannot be written as data: {value!r}. Name it (an initializer), or leave it open "
        "and give it to apply."
    )


def from_dict(data: Mapping[str, Any]) -> Plan:
    """The plan that :func:`to_dict` wrote.

    Raises:
        ValueError: an entry that is not known, is missing, or has the wrong type.

    >>> from_dict({"rules": [{"patterns": ["head/*"], "operation": "keep"}], "default": "copy"})
    Plan(rules=(Rule(patterns=('head/*',), operation='keep', parameters={}, source=None, \
layout=(), optional=False, frozen=False, note=''),), default='copy', name='')
    """
    _check_entries(data, "a plan", required=("rules",), known=("name", "rules", "default"))
    if not isinstance(data["rules"], Sequence) or isinstance(data["rules"], str):
        raise ValueError(f"Expected a plan's rules as a list, got {data['rules']!r}.")
    for entry in data["rules"]:
        _check_entries(entry, "a rule", required=("patterns", "operation"), known=_RULE_FIELDS)
    return Plan(
        tuple(Rule(**entry) for entry in data["rules"]),
        default=data.get("default"),
        name=data.get("name", ""),
    )


def _check_entries(data: Any, what: str, *, required: Sequence[str], known: Sequence[str]) -> None:
    if not isinstance(data, Mapping):
        raise ValueError(f"Expected {what} as a mapping of {', '.join(known)}; got {data!r}.")
    for name in required:
        if name not in data:
            raise ValueError(f"Expected {what} with {name!r}; got only {', '.join(data)}.")
    for name in data:
        if name not in known:
            raise ValueError(f"Unknown entry {name!r} of {what}; expected {', '.join(known)}.")


def write_plan(plan: Plan, path: str | os.PathLike) -> None:
    """Write a plan to a ``.json``, ``.yaml`` or ``.yml`` file.

    Raises:
        ValueError: another suffix, or as :func:`to_dict`.
    """
    data = to_dict(plan)
    if _is_json(path):
        text = json.dumps(data, indent=2, ensure_ascii=False) + "\n"
    else:
        text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=100)
    Path(path).write_text(text, encoding="utf-8")


def read_plan(path: str | os.PathLike) -> Plan:
    """The plan in a ``.json``, ``.yaml`` or ``.yml`` file.

    Raises:
        ValueError: another suffix, a file that cannot be parsed, or as :func:`from_dict`.
    """
    is_json = _is_json(path)
    text = Path(path).read_text(encoding="utf-8")
    try:
        data = json.loads(text) if is_json else yaml.safe_load(text)
        return from_dict(data)
    except (ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{path} holds no plan: {error}") from error


def _is_json(path: str | os.PathLike) -> bool:
    suffix = Path(path).suffix.lower()
    if suffix not in (".json", ".yaml", ".yml"):
        raise ValueError(f"A plan is written as .json, .yaml or .yml; got {os.fspath(path)!r}.")
    return suffix == ".json"
