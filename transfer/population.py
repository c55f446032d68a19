"""Populations: P trees of one structure as a single tree with leaves [P, ...]."""

from collections.abc import Sequence

import jax.numpy as jnp

from transfer.leaves import repeat
from transfer.select import PyTree, flatten, same_structure, unflatten


def stack(trees: Sequence[PyTree]) -> PyTree:
    """P trees as one population, every leaf [P, ...].

    Raises:
      ValueError: no trees; or trees that differ in structure, or in the shape or dtype of a leaf.

    >>> stack([{"w": jnp.zeros(2)}, {"w": jnp.ones(2)}])["w"].shape
    (2, 2)
    """
    trees = list(trees)
    if not trees:
        raise ValueError("stack needs at least one tree, got none.")
    first = flatten(trees[0])
    for index, tree in enumerate(trees[1:], start=1):
        same_structure(f"tree {index}", tree, "tree 0", trees[0])
        for path, leaf in flatten(tree).items():
            if (leaf.shape, leaf.dtype) != (first[path].shape, first[path].dtype):
                raise ValueError(
                    f"{path}: {first[path].dtype} {first[path].shape} in tree 0, "
                    f"{leaf.dtype} {leaf.shape} in tree {index}; they must be equal."
                )
    flat = [flatten(tree) for tree in trees]
    return unflatten(trees[0], {path: jnp.stack([tree[path] for tree in flat]) for path in first})


def unstack(population: PyTree) -> list[PyTree]:
    """The P members of a population.

    Raises:
      ValueError: the leaves do not share a leading axis.

    >>> [member["w"].item() for member in unstack({"w": jnp.array([1.0, 2.0])})]
    [1.0, 2.0]
    """
    leaves = flatten(population)
    return [
        unflatten(population, {path: leaf[member] for path, leaf in leaves.items()})
        for member in range(size(population))
    ]


def replicate(tree: PyTree, *, size: int) -> PyTree:
    """A population of `size` equal members.

    >>> replicate({"w": jnp.zeros(2)}, size=3)["w"].shape
    (3, 2)
    """
    return unflatten(tree, {path: repeat(leaf, size) for path, leaf in flatten(tree).items()})


def size(population: PyTree) -> int:
    """P, the leading axis that all leaves share.

    Raises:
      ValueError: there are no leaves, or their leading axes differ.
    """
    sizes: dict[str, int | None] = {
        path: leaf.shape[0] if leaf.shape else None for path, leaf in flatten(population).items()
    }
    found = next(iter(sizes.values()), None)
    if found is None or len(set(sizes.values())) != 1:
        raise ValueError(f"The leaves of a population must share a leading axis, got {sizes}.")
    return found
