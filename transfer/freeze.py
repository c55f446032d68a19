"""Leaves that do not train, or train later or slower, as Optax transforms.

All of these wrap an Optax optimiser and take selections as `select` does: a mask, a pattern or
several patterns over the paths of the parameters. The optimiser that is wrapped sees only the
leaves it trains, so that a global norm inside it is the norm of those.

Freezing has three prices, each avoidable: the update (`freeze`), the optimiser's memory
(`freeze` too) and the gradient (`partition` or `stop_gradient`).
"""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from transfer.patterns import match_paths
from transfer.select import PyTree, Where, flatten, join, paths, selected, split, unflatten


def _no_update() -> optax.GradientTransformation:
    def update(updates, state, params=None):
        # Minus zero, since -0.0 + 0.0 is +0.0: with this no bit of a parameter changes.
        return jax.tree.map(lambda update: -jnp.zeros_like(update), updates), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)


def _labels(label: Callable[[PyTree], Mapping[str, Any]]) -> Callable[[PyTree], PyTree]:
    """A function from parameters to a tree of labels, for `optax.partition`."""

    def tree_of_labels(params: PyTree) -> PyTree:
        return unflatten(params, label(params))

    return tree_of_labels


def freeze(
    optimizer: optax.GradientTransformation, where: Where
) -> optax.GradientTransformationExtraArgs:
    """An optimiser that leaves the selected parameters exactly as they are.

    Frozen leaves get no update whatever the optimiser does (weight decay, momentum), and it keeps
    no memory for them.

    Args:
      optimizer: what trains the other leaves.
      where: the frozen leaves.

    Raises:
      ValueError: at `init`, as `transfer.select`.

    >>> params = {"encoder": jnp.ones(2), "head": jnp.ones(2)}
    >>> optimizer = freeze(optax.sgd(0.5), "encoder")
    >>> updates, _ = optimizer.update(params, optimizer.init(params), params)
    >>> optax.apply_updates(params, updates)
    {'encoder': Array([1., 1.], dtype=float32), 'head': Array([0.5, 0.5], dtype=float32)}
    """

    def label(params):
        frozen = selected(params, where)
        return {path: "frozen" if path in frozen else "trained" for path in paths(params)}

    return optax.partition({"trained": optimizer, "frozen": _no_update()}, _labels(label))


class _DelayedState(NamedTuple):
    step: jax.Array
    inner: optax.OptState


def _is_schedule(node: Any) -> bool:
    """Whether a part of an optimiser's state counts the steps of a schedule."""
    return isinstance(node, _SCHEDULES)


_SCHEDULES = (optax.ScaleByScheduleState, optax.InjectHyperparamsState) + (
    (optax.InjectStatefulHyperparamsState,)
    if hasattr(optax, "InjectStatefulHyperparamsState")
    else ()
)


def _waiting(before: PyTree, after: PyTree) -> PyTree:
    """The state of an optimiser that waits: as it was, but for the steps of its schedules."""

    def choose(old, new):
        if not _is_schedule(old):
            return old
        if not hasattr(old, "inner_state"):
            return new
        return new._replace(inner_state=_waiting(old.inner_state, new.inner_state))

    return jax.tree.map(choose, before, after, is_leaf=_is_schedule)


def _delayed(
    optimizer: optax.GradientTransformation, start: Any, restart: bool
) -> optax.GradientTransformationExtraArgs:
    """An optimiser that begins, from its initial state, at step `start`."""
    optimizer = optax.with_extra_args_support(optimizer)

    def init(params):
        return _DelayedState(jnp.zeros((), jnp.int32), optimizer.init(params))

    def update(updates, state, params=None, **extra):
        new, inner = optimizer.update(updates, state.inner, params, **extra)
        active = state.step >= start
        new = jax.tree.map(lambda update: jnp.where(active, update, -jnp.zeros_like(update)), new)
        waiting = state.inner if restart else _waiting(state.inner, inner)
        inner = jax.tree.map(lambda a, b: jnp.where(active, a, b), inner, waiting)
        return new, _DelayedState(optax.safe_increment(state.step), inner)

    return optax.GradientTransformationExtraArgs(init, update)


def unfreeze_gradually(
    optimizer: optax.GradientTransformation,
    starts: Mapping[str | tuple[str, ...], int],
    *,
    schedules: Literal["continue", "restart"] = "continue",
) -> optax.GradientTransformationExtraArgs:
    """An optimiser that begins to train some leaves later than others.

    Until its first step a leaf is exactly as it was, and the optimiser's memory of it is fresh (so
    that Adam's bias correction is right when it begins). All leaves that begin at one step are one
    group with an optimiser of their own: what couples leaves, such as a global norm, sees the
    group. To couple all leaves put it outside:
    `optax.chain(optax.clip_by_global_norm(1.0), unfreeze_gradually(optax.adam(1e-3), ...))`.

    Args:
      optimizer: what trains each group.
      starts: pattern, or a tuple of patterns as `transfer.select` takes them -> the first
        step (0 is the first of all) at which its leaves train. Leaves that no pattern names
        train from the first step on.
      schedules: whether a schedule inside the optimiser (a learning rate that decays) counts
        all steps of the training, so that late leaves begin with the rate of the moment, or
        restarts for each group with its first step. Known are those of Optax
        (`optax.scale_by_schedule`, a rate given as a schedule, `optax.inject_hyperparams`).

    Raises:
      ValueError: a start that is no step; at `init`, where a pattern matches nothing or two
        match one leaf.

    >>> params = {"body": jnp.ones(1), "head": jnp.ones(1)}
    >>> optimizer = unfreeze_gradually(optax.sgd(0.5), {"body": 1})
    >>> state = optimizer.init(params)
    >>> for step in range(2):
    ...     updates, state = optimizer.update(params, state, params)
    ...     params = optax.apply_updates(params, updates)
    ...     print(params["body"], params["head"])
    [1.] [0.5]
    [0.5] [0.25]
    """
    if schedules not in ("continue", "restart"):
        raise ValueError(f"schedules is 'continue' or 'restart'; got {schedules!r}.")
    for patterns, start in starts.items():
        if isinstance(start, bool) or not isinstance(start, int | np.integer) or start < 0:
            raise ValueError(f"{patterns!r} starts at {start!r}; expected a step, 0 or more.")
    groups = {
        int(start): _delayed(optimizer, int(start), schedules == "restart") if start else optimizer
        for start in {0, *starts.values()}
    }

    def label(params):
        return _claim(params, {key: int(start) for key, start in starts.items()}, default=0)

    return optax.partition(groups, _labels(label))


def scale_learning_rates(
    optimizer: optax.GradientTransformation, multipliers: Mapping[str | tuple[str, ...], Any]
) -> optax.GradientTransformationExtraArgs:
    """An optimiser whose updates of some leaves are multiplied by a factor.

    Args:
      optimizer: the optimiser; its update of a leaf is scaled, whatever it consists of.
      multipliers: pattern, or a tuple of patterns as `transfer.select` takes them ->
        factor, a scalar that may be traced. Leaves that no pattern names have factor 1. For a
        factor of 0 use `freeze`, which keeps no memory.

    Raises:
      ValueError: at the first update, where a pattern matches nothing or two match one leaf.

    >>> params = {"body": jnp.ones(1), "head": jnp.ones(1)}
    >>> optimizer = scale_learning_rates(optax.sgd(0.5), {"body": 0.1})
    >>> optimizer.update(params, optimizer.init(params), params)[0]
    {'body': Array([-0.05], dtype=float32), 'head': Array([-0.5], dtype=float32)}
    """

    def scale(updates, state, params=None):
        factors = _claim(updates, multipliers, default=None)
        scaled = {
            path: update if factors[path] is None else (update * factors[path]).astype(update.dtype)
            for path, update in flatten(updates).items()
        }
        return unflatten(updates, scaled), state

    scaling = optax.GradientTransformation(lambda params: optax.EmptyState(), scale)
    return optax.with_extra_args_support(optax.chain(optimizer, scaling))


def _claim(tree: PyTree, values: Mapping[Any, Any], *, default: Any) -> dict[str, Any]:
    """The value whose pattern matches each leaf, by path; an error where two do."""
    names = paths(tree)
    claimed: dict[str, Any] = {}
    for pattern in values:
        for path in sorted(match_paths(names, pattern)):
            if path in claimed:
                raise ValueError(
                    f"{path} is named by two patterns, {claimed[path]!r} and {pattern!r}."
                )
            claimed[path] = pattern
    return {path: values[claimed[path]] if path in claimed else default for path in names}


def partition(tree: PyTree, where: Where) -> tuple[PyTree, PyTree]:
    """A tree in two: the selected leaves and the rest, each with `None` for the other's.

    A gradient with respect to one part costs nothing for the other:
    `jax.grad(lambda trained: loss(combine(trained, frozen)))(trained)`. What is not an array
    goes with the rest.

    >>> frozen, trained = partition({"encoder": jnp.ones(1), "head": jnp.ones(1)}, "encoder")
    >>> jax.grad(lambda part: (combine(part, frozen)["head"] ** 2).sum())(trained)
    {'encoder': None, 'head': Array([2.], dtype=float32)}
    """
    return split(tree, selected(tree, where))


def combine(*parts: PyTree) -> PyTree:
    """The tree that `partition` split.

    Raises:
      ValueError: two parts hold the same leaf, or differ in structure.

    >>> combine({"a": 1.0, "b": None}, {"a": None, "b": 2.0})
    {'a': 1.0, 'b': 2.0}
    """

    def choose(*leaves):
        there = [leaf for leaf in leaves if leaf is not None]
        if len(there) > 1:
            raise ValueError(f"Expected each leaf in one part, found one in {len(there)} of them.")
        return there[0] if there else None

    return join(choose, parts)


def stop_gradient(tree: PyTree, where: Where) -> PyTree:
    """The tree with no gradient through the selected leaves; their gradients are zero.

    >>> loss = lambda tree: sum(stop_gradient(tree, "encoder").values())
    >>> jax.grad(loss)({"encoder": 1.0 * jnp.ones(()), "head": jnp.ones(())})
    {'encoder': Array(0., dtype=float32), 'head': Array(1., dtype=float32)}
    """
    leaves = flatten(tree)
    return unflatten(
        tree, {path: jax.lax.stop_gradient(leaves[path]) for path in selected(tree, where)}
    )
