"""Waiting for the device in a way that Ctrl-C can interrupt."""

import time
from typing import Any, TypeVar

import jax
import numpy as np

Tree = TypeVar("Tree")


def wait_for(tree: Any) -> None:
    """Waits until a tree of JAX arrays is computed.

    Python handles signals between two steps of its own, and `jax.block_until_ready` is one step
    that lasts as long as the simulators that a program calls. So this asks again and again, a
    hundredth of the time waited apart.
    """
    began = time.monotonic()
    while not all(_is_ready(x) for x in jax.tree.leaves(tree)):
        time.sleep(min(0.05, 1e-4 + (time.monotonic() - began) / 100))


def to_host(tree: Tree) -> Tree:
    """A tree of JAX arrays, computed (see `wait_for`), as NumPy arrays."""
    wait_for(tree)
    return jax.tree.map(np.asarray, tree)


def _is_ready(leaf: Any) -> bool:
    return not isinstance(leaf, jax.Array) or leaf.is_ready()  # type: ignore[attr-defined]
