"""Plans as data: plain dictionaries, and JSON or YAML files, both ways.

Reading builds strings, numbers, lists and mappings only: a file cannot execute code, and names an
operation by its name in `OPERATIONS`.
"""

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

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
    if isinstance(value, Mapping):
        return {key: _plain(f"{key!r} in {name}", item) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [_plain(name, item) for item in value]
    raise ValueError(
        f"{name} cannot be written as data: {value!r}. Name it (an initializer), or leave it open "
        "and give it to apply."
    )


def from_dict(data: Mapping[str, Any]) -> Plan:
    """The plan that `to_dict` wrote.

    Raises:
      ValueError: an entry that is not known, is missing, or has the wrong type.

    >>> from_dict({"rules": [{"patterns": ["head/*"], "operation": "keep"}], "default": "copy"})
    Plan(rules=(Rule(patterns=('head/*',), operation='keep', parameters={}, source=None, \
optional=False, frozen=False, note='', layout=()),), default='copy', name='')
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
    """Write a plan to a `.json`, `.yaml` or `.yml` file.

    Raises:
      ValueError: another suffix, or as `to_dict`.
    """
    data = to_dict(plan)
    if _is_json(path):
        text = json.dumps(data, indent=2, ensure_ascii=False) + "\n"
    else:
        text = _yaml().safe_dump(data, sort_keys=False, allow_unicode=True, width=100)
    Path(path).write_text(text, encoding="utf-8")


def read_plan(path: str | os.PathLike) -> Plan:
    """The plan in a `.json`, `.yaml` or `.yml` file.

    Raises:
      ValueError: another suffix, a file that cannot be parsed or has a key twice, or as
        `from_dict`.
    """
    data = read_data(path)
    try:
        return from_dict(data)
    except ValueError as error:
        raise ValueError(f"{path} holds no plan: {error}") from error


def read_data(path: str | os.PathLike) -> Any:
    """What a `.json`, `.yaml` or `.yml` file holds: numbers, text, lists and mappings.

    Raises:
      ValueError: another suffix, a file that cannot be parsed, or a mapping with a key twice.
    """
    if _is_json(path):
        try:
            text = Path(path).read_text(encoding="utf-8")
            return json.loads(text, object_pairs_hook=_without_repetition)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path} holds no plan: {error}") from error
    yaml = _yaml()

    class Loader(yaml.SafeLoader):  # type: ignore[name-defined]
        def construct_mapping(self, node, deep=False):
            keys = [self.construct_object(key, deep=True) for key, _ in node.value]
            _without_repetition([(str(key), None) for key in keys])
            return super().construct_mapping(node, deep)

    try:
        return yaml.load(Path(path).read_text(encoding="utf-8"), Loader)
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        raise ValueError(f"{path} holds no plan: {error}") from error


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key {key!r} comes twice.")
        found[key] = value
    return found


def _yaml() -> Any:
    try:
        import yaml
    except ImportError:
        raise ImportError(
            "Plans in YAML need the package PyYAML: pip install 'dreamer-transfer[files]'. "
            "Plans in JSON need nothing."
        ) from None
    return yaml


def _is_json(path: str | os.PathLike) -> bool:
    suffix = Path(path).suffix.lower()
    if suffix not in (".json", ".yaml", ".yml"):
        raise ValueError(f"A plan is written as .json, .yaml or .yml; got {os.fspath(path)!r}.")
    return suffix == ".json"
