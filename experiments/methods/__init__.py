"""The methods of transfer: what each does to an agent, and the networks it adds.

Each file of this folder that names a METHOD is one; nothing else lists them.
"""

import functools
import importlib
import pkgutil
from collections.abc import Mapping
from typing import Any

from experiments.methods.base import BASELINE, Method, Sources, combinations, require
from experiments.methods.fractional import FractionalTransfer
from experiments.methods.scratch import Scratch

__all__ = ["BASELINE", "Method", "Sources", "combinations", "known", "make", "named", "options"]


@functools.cache
def known() -> dict[str, type[Method]]:
    """All methods by name."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        if not module.ispkg:
            method = getattr(importlib.import_module(f"{__name__}.{module.name}"), "METHOD", None)
            if method is not None:
                found[method.NAME] = method
    return found


def named(name: str) -> type[Method]:
    """The method of that name.

    Raises:
      ValueError: there is none; names those there are.
    """
    require(name in known(), f"there is no method {name!r}: choose from {', '.join(known())}")
    return known()[name]


def options() -> dict[str, tuple[Any, tuple[str, ...]]]:
    """The settings of all methods: name -> (its field, the names of the methods that have it).

    Methods that share a setting share its option.
    """
    import dataclasses

    fields: dict[str, Any] = {}
    owners: dict[str, list[str]] = {}
    for method in known().values():
        for field in dataclasses.fields(method):
            fields.setdefault(field.name, field)
            owners.setdefault(field.name, []).append(method.NAME)
    return {name: (field, tuple(owners[name])) for name, field in fields.items()}


def make(name: str | None, settings: Mapping[str, Any]) -> Method:
    """A method from its settings.

    Args:
      name: which one; without it, fractional transfer if anything is set, and none if nothing is.
      settings: by name. Those of other methods may be among them, as long as they are not set.

    Raises:
      ValueError: there is no such method or setting, it belongs to another method, or the method's
        own checks fail.
    """
    there = options()
    unknown = sorted(set(settings) - set(there))
    require(not unknown, f"unknown settings of a method: {', '.join(unknown)}")
    given = {key: value for key, value in settings.items() if value != there[key][0].default}
    if name is None:
        name = FractionalTransfer.NAME if given else Scratch.NAME
    method = named(name)
    for key in given:
        field, owners = there[key]
        require(
            method.NAME in owners,
            f"--{field.metadata['option']} belongs to --method {' or '.join(owners)}, and the "
            f"method here is {method.NAME}",
        )
    return method(**given)
