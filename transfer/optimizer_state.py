"""The state of an optimiser moved with the parameters, by the same plan.

Optax keeps what it remembers of a parameter (Adam's moments, a momentum) in trees like that of the
parameters, somewhere in its state: the *slots* `0/mu/...` and `0/nu/...`. A plan for parameters
says what becomes of each of these too.
"""

from collections.abc import Callable, Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp

from transfer.execution import OPERATIONS
from transfer.layout import arrange
from transfer.leaves import check_shape, find
from transfer.plan import Operations, Plan, Rule, claims
from transfer.reading import source_places
from transfer.select import PyTree, flatten, unflatten
from transfer.surgery import copy, crop, pad, splice, take
from transfer.values import check_range

MOVES: Mapping[str, Callable[..., PyTree]] = {
    move.__name__: move for move in (copy, take, splice, pad, crop)
}
"""The operations that put numbers of the source, unchanged, into the target: memory moves too."""


def apply_to_optimizer(
    plan: Plan,
    target: PyTree,
    target_state: PyTree,
    source_state: PyTree,
    *,
    moments: Literal["copy", "scale", "reset"] = "copy",
    scale: Any = None,
    counts: Literal["source", "target"] | None = None,
    operations: Operations = OPERATIONS,
) -> tuple[PyTree, dict[str, str]]:
    """The state of an optimiser after the plan that its parameters were transferred by.

    A leaf of a slot follows its parameter. Where the plan moves the source's numbers (`copy`,
    `take`, `splice`, `pad`, `crop`, renamed and in another layout too) the memory is moved
    in the same way, and what the source does not fill is fresh. Where the plan keeps, draws, mixes
    or merges, the parameter is a new one, and its memory stays fresh.

    Args:
      plan: the plan of the parameters; of one source.
      target: the parameters that the plan was applied to; only paths and shapes are read.
      target_state: `optimizer.init(...)` of the new parameters.
      source_state: the source's optimiser state, of the same optimiser.
      moments: `"copy"` the memory; `"scale"` it, gradients being expected `scale` times as
        large: first moments and momenta times s, second moments (slots called `nu`) times s²;
        or `"reset"` everything, which gives `target_state`.
      scale: s, a scalar of 0 or more, for `"scale"`.
      counts: whether numbers of steps (Adam's bias correction, schedules) are the source's or the
        target's. By default the source's where the memory of every parameter was moved, the
        target's where none was; where only some was, one number cannot be right for all, and it
        must be said: with the source's, fresh moments are not corrected (their first steps are
        up to 3 times too long with Adam's usual decays); with the target's, moved ones are
        corrected twice (a third of the length).
      operations: as for `transfer.apply`.

    Returns:
      The state, and what happened to each of its leaves: `{path: "copied" | "scaled" | "reset" |
      "source's count" | "target's count"}`.

    Raises:
      ValueError: a plan of several sources, a leaf that the source's state lacks, `counts` not
        given where it must be, or as the operations.

    >>> params, adam = {"body": jnp.ones(2), "head": jnp.ones(2)}, optax.adam(0.1)
    >>> _, old = adam.update(params, adam.init(params), params)
    >>> plan = Plan((Rule("body", "copy"), Rule("head", "keep")))
    >>> state, done = apply_to_optimizer(plan, params, adam.init(params), old, counts="target")
    >>> done["0/mu/body"], done["0/mu/head"], (state[0].mu["body"] == old[0].mu["body"]).tolist()
    ('copied', 'reset', [True, True])
    """
    if moments not in ("copy", "scale", "reset"):
        raise ValueError(f"moments is 'copy', 'scale' or 'reset'; got {moments!r}.")
    if (scale is None) is (moments == "scale"):
        raise ValueError(f"scale belongs to moments='scale'; got scale={scale} for {moments!r}.")
    if scale is not None:
        check_range("scale", scale, low=0.0, high=None)
    claimed, shapes = claims(plan, target), flatten(target)
    fresh, old = flatten(target_state), flatten(source_state)
    done: dict[str, str] = {}
    new: dict[str, Any] = {}
    for path, leaf in fresh.items():
        parameter = _parameter(path, leaf, shapes)
        if parameter is None:
            continue
        rule, slot = claimed[parameter], path[: len(path) - len(parameter)]
        if moments == "reset" or rule.operation not in MOVES:
            done[path] = "reset"
            continue
        new[path] = _moved(rule, parameter, slot, leaf, old, operations)
        done[path] = "copied"
        if moments == "scale":
            factor = scale**2 if slot.rstrip("/").split("/")[-1] == "nu" else scale
            new[path] = (new[path] * factor).astype(leaf.dtype)
            done[path] = "scaled"
    moved = len(new)
    if counts is None and moments != "reset" and 0 < moved < len(done):
        raise ValueError(
            f"The memory of {moved} of {len(done)} leaves was moved and that of the others is "
            "fresh: say counts='source' or counts='target' for the optimiser's numbers of steps."
        )
    whose = counts or ("source" if moved and moved == len(done) else "target")
    for path, leaf in fresh.items():
        if path in done:
            continue
        done[path] = f"{whose}'s count"
        if whose == "source":
            new[path] = find(old, path)
            check_shape(path, leaf, new[path])
    return unflatten(target_state, new), done


def _parameter(path: str, leaf: Any, shapes: Mapping[str, Any]) -> str | None:
    """The parameter that a leaf of an optimiser's state is the memory of, if it is one."""
    parts = path.split("/")
    for start in range(1, len(parts)):
        name = "/".join(parts[start:])
        if name in shapes and shapes[name].shape == leaf.shape:
            return name
    return None


def _moved(
    rule: Rule, parameter: str, slot: str, leaf: Any, old: Mapping[str, Any], operations: Operations
) -> jax.Array:
    """A leaf of a slot as the rule makes its parameter, from the source's slot."""
    if any(reading.name is not None for reading in rule.readings):
        raise ValueError(
            f"The rule '{rule}' names its source; the state of an optimiser is moved by plans of "
            "one source."
        )
    names = {name.removeprefix(slot): name for name in old if name.startswith(slot)}
    places = source_places(rule, parameter, names)
    arrays = [find(old, names.get(place, slot + place)) for place in places]
    array = arrays[0]
    if rule.layout or len(arrays) > 1:
        array = arrange(parameter, arrays, rule.layout, rule.captured(parameter))
    operation = operations[rule.operation]
    # What the source does not fill is fresh, whatever the parameter is filled with.
    settings = {name: value for name, value in rule.parameters.items() if name != "fill"}
    made = operation({parameter: jnp.asarray(leaf)}, {parameter: array}, **settings)
    return made[parameter]
