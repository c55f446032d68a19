"""Which leaves of an agent's parameters are trained.

A frozen name is a path: that of a leaf, or of all leaves below it ("encoder", "dynamics/gru",
"dynamics/prior/out/kernel"). Gradients are taken, and optimisers keep their memory, for the other
leaves only.
"""

from collections.abc import Sequence
from typing import Any

Params = dict[str, Any]


def trained(params: Params, frozen: Sequence[str], prefix: str = "") -> Params:
    """The leaves that are not frozen, in dicts as they were; a dict without any is left out.

    Args:
      params: nested dicts.
      frozen: paths of leaves, or of what holds them.
      prefix: the path of `params` itself, with a "/" at its end.
    """
    found = {}
    for name, value in params.items():
        path = f"{prefix}{name}"
        if path in frozen:
            continue
        if isinstance(value, dict):
            value = trained(value, frozen, f"{path}/")
            if not value:
                continue
        found[name] = value
    return found


def joined(params: Params, parts: Params) -> Params:
    """Parameters with the leaves of `parts` in place of their own."""
    return params | {
        name: joined(params[name], value) if isinstance(value, dict) else value
        for name, value in parts.items()
    }


def check_frozen(params: Params, frozen: Sequence[str]) -> None:
    """Checks that what is to be frozen is there.

    A component that the agent does without may be named.

    Raises:
      ValueError: a path below a component is none of the parameters'; with those that there are.
    """
    for path in frozen:
        component, *names = path.split("/")
        if not names:
            continue
        if component not in params:
            raise ValueError(f"cannot freeze {path!r}: {component} is not in this agent")
        node, above = params[component], component
        for name in names:
            if not isinstance(node, dict):
                raise ValueError(f"cannot freeze {path!r}: {above} is a leaf")
            if name not in node:
                raise ValueError(
                    f"cannot freeze {path!r}: the parts of {above} are {', '.join(sorted(node))}"
                )
            node, above = node[name], f"{above}/{name}"
