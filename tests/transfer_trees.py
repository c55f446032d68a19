"""Trees for the tests of the transfer library: random ones, and those of the usual libraries."""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import haiku as hk
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen, nnx
from hypothesis import strategies as st

from transfer import flatten

# Few shapes and dtypes, since each new combination compiles anew.
SHAPES = ((), (2,), (3, 2))
DTYPES = (jnp.float32, jnp.bfloat16, jnp.float16)


class Pair(NamedTuple):
    first: Any
    second: Any


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Layer:
    kernel: Any
    rest: Any


@st.composite
def leaf(draw):
    """A random array; multiples of 1/8 below 4, so that sums and halves are exact in bfloat16."""
    shape, dtype = draw(st.sampled_from(SHAPES)), draw(st.sampled_from(DTYPES))
    values = np.random.default_rng(draw(st.integers(0, 2**16))).integers(-32, 32, shape)
    return np.asarray(values / 8, dtype)


def trees():
    """Random trees of dictionaries, lists, tuples, named tuples and dataclasses.

    Of NumPy arrays, for which nothing is compiled; `on_device` makes JAX arrays of them.
    """
    names = st.text("abc", min_size=1, max_size=2)
    return st.recursive(
        leaf(),
        lambda children: st.one_of(
            st.dictionaries(names, children, min_size=1, max_size=3),
            st.lists(children, min_size=1, max_size=3),
            st.tuples(children, children),
            st.builds(Pair, children, children),
            st.builds(Layer, kernel=children, rest=st.just({"none": None, "size": 3})),
        ),
        max_leaves=6,
    ).map(lambda tree: {"root": tree})


def on_device(tree):
    """The tree with JAX arrays in place of NumPy arrays."""
    return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, tree)


def like(tree, seed):
    """Another tree of the same structure, shapes and dtypes, with other values."""
    random = np.random.default_rng(seed)

    def other(array):
        if not jnp.issubdtype(array.dtype, jnp.floating):
            return array
        values = np.asarray(random.integers(-32, 32, array.shape) / 8, array.dtype)
        return jnp.asarray(values) if isinstance(array, jax.Array) else values

    return jax.tree.map(lambda x: other(x) if hasattr(x, "dtype") else x, tree)


class LinenNet(linen.Module):
    @linen.compact
    def __call__(self, x):
        return linen.Dense(2, name="out")(linen.relu(linen.Dense(3, name="hidden")(x)))


class NnxNet(nnx.Module):
    def __init__(self, rngs):
        self.hidden = nnx.Linear(4, 3, rngs=rngs)
        self.out = nnx.Linear(3, 2, rngs=rngs)


def _linen():
    return LinenNet().init(jax.random.key(0), jnp.ones((1, 4)))["params"]


def _haiku():
    net = hk.without_apply_rng(hk.transform(lambda x: hk.nets.MLP([3, 2])(x)))
    return net.init(jax.random.PRNGKey(0), jnp.ones((1, 4)))


def _optax():
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1e-3))
    state = optimizer.init(_linen())
    return optimizer.update(_linen(), state, _linen())[1]


LIBRARIES = {
    "linen": _linen,
    "nnx state": lambda: nnx.state(NnxNet(nnx.Rngs(0))),
    "nnx module": lambda: NnxNet(nnx.Rngs(0)),
    "equinox": lambda: eqx.nn.MLP(4, 2, 3, 1, key=jax.random.key(0)),
    "haiku": _haiku,
    "optax": _optax,
}


@functools.cache
def library_tree(name):
    return LIBRARIES[name]()


def floating(tree):
    """The paths of the floating-point leaves."""
    return [path for path, x in flatten(tree).items() if jnp.issubdtype(x.dtype, jnp.floating)]


def bits(tree):
    """Every array of a tree as bytes, by path."""
    return {path: np.asarray(x).tobytes() for path, x in flatten(tree).items()}


def assert_same_kind(tree, expected):
    """Equal structure, shapes and dtypes."""
    assert jax.tree.structure(tree) == jax.tree.structure(expected)
    kinds = [
        {path: (x.shape, x.dtype) for path, x in flatten(one).items()} for one in (tree, expected)
    ]
    assert kinds[0] == kinds[1]
