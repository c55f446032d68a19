"""The operations of the transfer library, as laws over random trees and over every library."""

import dataclasses

import equinox as eqx
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from hypothesis import strategies as st

import transfer
from transfer_trees import (
    LIBRARIES,
    assert_same_kind,
    bits,
    floating,
    library_tree,
    like,
    on_device,
    trees,
)

many = hypothesis.settings(max_examples=50, deadline=None)
few = hypothesis.settings(max_examples=10, deadline=None)  # of what compiles for every example
KEY = jax.random.key(0)

ARITHMETIC = {
    "fraction": lambda t, s, w=None: transfer.fraction(t, s, omega=0.5, where=w),
    "interpolate": lambda t, s, w=None: transfer.interpolate(t, s, weight=0.5, where=w),
    "shrink_perturb": lambda t, s, w=None: transfer.shrink_perturb(
        t, s, shrink=0.5, noise=0.1, key=KEY, where=w
    ),
    "average": lambda t, s, w=None: transfer.average(t, [t, s], where=w),
    "copy": lambda t, s, w=None: transfer.copy(t, s, where=w),
    "keep": lambda t, s, w=None: transfer.keep(t, where=w),
    "reinitialise": lambda t, s, w=None: transfer.reinitialise(
        t, initializer="normal", key=KEY, where=w
    ),
}


def close(a, b, tolerance=1e-6):
    """All leaves of two trees equal up to one rounding in their own dtype."""
    for path, x in transfer.flatten(a).items():
        y = transfer.flatten(b)[path]
        allowed = max(tolerance, float(jnp.finfo(x.dtype).eps) * 4)
        np.testing.assert_allclose(
            np.asarray(x, np.float64), np.asarray(y, np.float64), rtol=allowed, atol=allowed
        )


# --- laws --------------------------------------------------------------------------------------


def check_laws_of_fraction(target, source, where):
    zero = transfer.fraction(target, source, omega=0.0, where=where)
    assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), *map(arrays, (zero, target))))

    empty = {path: jnp.zeros_like(transfer.flatten(target)[path]) for path in where}
    nothing = transfer.unflatten(target, empty)
    full = transfer.fraction(nothing, source, omega=1.0, where=where)
    assert bits(full) == bits(transfer.copy(nothing, source, where=where))

    # Exact, since all values are multiples of 1/8: f(a + b) - f(0) = f(a) - f(0) + f(b) - f(0).
    f = lambda omega: arrays(transfer.fraction(target, source, omega=omega, where=where))  # noqa: E731
    for path in where:
        wide = lambda x, path=path: np.asarray(x[path], np.float32)  # noqa: E731
        step, both = wide(f(0.5)) - wide(f(0.0)), wide(f(1.0)) - wide(f(0.0))
        np.testing.assert_allclose(both, 2 * step, atol=0.1 if is_half(f(0.0)[path]) else 1e-5)


def is_half(x):
    return x.dtype != jnp.float32


def arrays(tree):
    """The arrays of a tree, by path, without PRNG keys."""
    return {
        path: x
        for path, x in transfer.flatten(tree).items()
        if not jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    }


@many
@hypothesis.given(trees(), st.integers(0, 99))
def test_fraction_is_linear_the_identity_at_zero_and_a_copy_onto_nothing_at_one(target, seed):
    check_laws_of_fraction(target, like(target, seed), floating(target))


@pytest.mark.parametrize("name", LIBRARIES)
def test_fraction_obeys_its_laws_on_trees_of_every_library(name):
    target = like(library_tree(name), 1)
    check_laws_of_fraction(target, like(target, 2), floating(target))


@many
@hypothesis.given(trees(), st.integers(0, 99), st.sampled_from(sorted(ARITHMETIC)), st.data())
def test_structure_shape_dtype_and_all_leaves_outside_the_selection_are_kept(
    target, seed, name, data
):
    check_untouched(name, target, like(target, seed), data.draw(subsets(target)))


@pytest.mark.parametrize("name", ARITHMETIC)
@pytest.mark.parametrize("library", LIBRARIES)
def test_operations_keep_trees_of_every_library_what_they_are(library, name):
    target = like(library_tree(library), 1)
    check_untouched(name, target, like(target, 2), floating(target)[::2])


def subsets(tree):
    return st.lists(st.sampled_from(floating(tree)), min_size=1, unique=True)


def check_untouched(name, target, source, where):
    before, before_source = bits(arrays(target)), bits(arrays(source))
    result = ARITHMETIC[name](target, source, where)
    assert_same_kind(result, target)
    old, new = transfer.flatten(target), transfer.flatten(result)
    assert all(new[path] is old[path] for path in old if path not in where)
    assert bits(arrays(target)) == before and bits(arrays(source)) == before_source


@few
@hypothesis.given(trees(), st.integers(0, 99), st.sampled_from(sorted(ARITHMETIC)))
def test_jit_equals_eager(target, seed, name):
    target = on_device(target)
    source = like(target, seed)
    jitted = eqx.filter_jit(ARITHMETIC[name])(target, source)
    close(jitted, ARITHMETIC[name](target, source))


@few
@hypothesis.given(trees(), st.integers(0, 99))
def test_vmap_over_omega_equals_a_loop(target, seed):
    target = on_device(target)
    source = like(target, seed)
    only = lambda tree: transfer.flatten(tree)  # noqa: E731
    omegas = jnp.array([0.0, 0.25, 1.0])
    mapped = jax.vmap(lambda w: transfer.fraction(only(target), source, omega=w))(omegas)
    for member, omega in enumerate(omegas):
        one = transfer.fraction(only(target), source, omega=omega)
        close({path: x[member] for path, x in mapped.items()}, one)


@few
@hypothesis.given(trees(), st.integers(0, 99))
def test_a_stacked_population_with_an_omega_each_equals_its_members_one_by_one(target, seed):
    targets = [like(target, seed + i) for i in range(3)]
    sources = [like(target, seed + 10 + i) for i in range(3)]
    omegas = [0.0, 0.5, 1.0]
    stacked = transfer.fraction(
        transfer.stack(targets),
        transfer.stack(sources),
        omega=jnp.array(omegas),
        population=True,
    )
    for member, t, s, omega in zip(
        transfer.unstack(stacked), targets, sources, omegas, strict=True
    ):
        close(member, transfer.fraction(t, s, omega=omega))


@few
@hypothesis.given(trees())
def test_unstack_undoes_stack(tree):
    members = [like(tree, seed) for seed in range(3)]
    again = transfer.unstack(transfer.stack(members))
    assert [bits(member) for member in again] == [bits(member) for member in members]
    assert_same_kind(again[0], tree)


def test_gradients_pass_through_the_operations():
    target, source = {"w": jnp.array([1.0, 2.0])}, {"w": jnp.array([3.0, -1.0])}
    total = lambda omega: transfer.fraction(target, source, omega=omega)["w"].sum()  # noqa: E731
    assert jax.grad(total)(0.3) == 2.0


# --- what each operation does --------------------------------------------------------------------


def test_fraction_in_bfloat16_rounds_once():
    target = {"w": jnp.array([1.0], jnp.bfloat16)}
    source = {"w": jnp.array([3.0], jnp.bfloat16)}
    # 1.8984375 is the bfloat16 nearest to 1.9; rounding ω and the product too gives 1.90625.
    assert transfer.fraction(target, source, omega=0.3)["w"][0] == 1.8984375


def test_a_source_may_be_of_another_dtype_and_structure():
    module = transfer.copy(library_tree("nnx state"), library_tree("linen"))
    assert bits(module) == bits(library_tree("linen"))
    assert isinstance(module["out"]["kernel"], nnx.Param)
    low = {"w": jnp.zeros(2, jnp.bfloat16)}
    assert transfer.copy(low, {"w": np.array([1.0, 2.0])})["w"].dtype == jnp.bfloat16


def test_nnx_models_take_the_result():
    from transfer_trees import NnxNet

    model = NnxNet(nnx.Rngs(3))
    state = transfer.copy(nnx.state(model), library_tree("linen"), where="out/**")
    nnx.update(model, state)
    np.testing.assert_array_equal(
        np.asarray(model.out.kernel[...]), library_tree("linen")["out"]["kernel"]
    )


def test_equinox_modules_work_after_surgery():
    target = eqx.nn.MLP(4, 2, 3, 1, activation=jnp.tanh, key=jax.random.key(7))
    source = library_tree("equinox")
    new = transfer.copy(target, source)
    assert new.activation is jnp.tanh
    assert new(jnp.ones(4)).shape == (2,)


def test_shapes_that_differ_are_named_with_a_way_out():
    target, source = {"out": {"kernel": jnp.ones((4, 6))}}, {"out": {"kernel": jnp.ones((4, 16))}}
    for operation in (transfer.copy, ARITHMETIC["fraction"], ARITHMETIC["interpolate"]):
        with pytest.raises(ValueError, match=r"out/kernel.*\(4, 6\).*\(4, 16\).*pad or crop"):
            operation(target, source)


def test_nothing_broadcasts_even_where_numpy_would():
    with pytest.raises(ValueError, match=r"w: the target has shape \(3, 2\), the source \(1, 2\)"):
        transfer.copy({"w": jnp.ones((3, 2))}, {"w": jnp.ones((1, 2))})
    with pytest.raises(ValueError, match="population"):
        transfer.copy({"w": jnp.ones((3, 2))}, {"w": jnp.ones(2)})
    with pytest.raises(ValueError, match=r"omega has shape \(2,\).*\(3,\)"):
        transfer.fraction(
            {"w": jnp.ones((3, 2))},
            {"w": jnp.ones((3, 2))},
            omega=jnp.ones(2),
            population=True,
        )


def test_a_leaf_the_source_lacks_is_an_error_only_where_it_is_needed():
    target, source = {"a": jnp.zeros(1), "b": jnp.zeros(1)}, {"a": jnp.ones(1)}
    assert transfer.copy(target, source, where="a")["a"] == 1
    with pytest.raises(ValueError, match="source has no leaf 'b'"):
        transfer.copy(target, source)


def test_integers_and_keys_can_be_copied_but_not_added():
    tree = {"count": jnp.array(3), "key": jax.random.key(1)}
    copied = transfer.copy({"count": jnp.array(0), "key": jax.random.key(0)}, tree)
    assert copied["count"] == 3
    assert (jax.random.key_data(copied["key"]) == jax.random.key_data(tree["key"])).all()
    for path in tree:
        with pytest.raises(ValueError, match=f"{path}: fraction needs floating-point"):
            transfer.fraction(tree, tree, omega=0.5, where=path)


def test_a_float64_target_is_refused_where_jax_would_narrow_it():
    wide = {"w": np.ones(2)}
    for source in (wide, {"w": jnp.ones(2)}):
        with pytest.raises(ValueError, match="w: the target is float64"):
            transfer.copy(wide, source)
    with pytest.raises(ValueError, match="w: the target is float64"):
        transfer.fraction(wide, wide, omega=0.5)
    with jax.enable_x64(True):
        assert transfer.fraction(wide, wide, omega=0.5)["w"].dtype == np.float64


def test_reinitialise_draws_from_the_initializer_with_a_key_for_each_leaf():
    tree = {"a": jnp.ones((200, 300)), "b": jnp.ones((200, 300))}
    new = transfer.reinitialise(tree, initializer="glorot_uniform", key=KEY)
    limit = np.sqrt(6 / 500)
    assert (abs(new["a"]) <= limit).all() and abs(new["a"]).max() > 0.99 * limit
    assert (new["a"] != new["b"]).mean() > 0.99
    alone = transfer.reinitialise(tree, initializer="glorot_uniform", key=KEY, where="b")
    assert bits(alone)["b"] == bits(new)["b"]


def test_reinitialise_takes_functions_names_and_names_with_arguments():
    tree = {"w": jnp.ones((3, 2))}
    draw = lambda initializer: transfer.reinitialise(tree, initializer=initializer, key=KEY)  # noqa: E731
    assert (draw({"name": "constant", "value": 2.5})["w"] == 2.5).all()
    assert bits(draw("orthogonal")) == bits(draw(jax.nn.initializers.orthogonal()))
    with pytest.raises(ValueError, match="'glorot' is not known; expected one of"):
        draw("glorot")
    with pytest.raises(ValueError, match=r"b: initializer 'glorot_uniform' cannot draw shape \(2,"):
        transfer.reinitialise({"b": jnp.ones(2)}, initializer="glorot_uniform", key=KEY)


def test_members_of_a_population_are_reinitialised_each_with_its_own_key():
    keys = jax.random.split(KEY, 3)
    tree = {"w": jnp.ones((50, 40))}
    population = transfer.replicate(tree, size=3)
    drawn = transfer.reinitialise(
        population, initializer="glorot_uniform", key=keys, population=True
    )
    for member, key in zip(transfer.unstack(drawn), keys, strict=True):
        assert bits(member) == bits(
            transfer.reinitialise(tree, initializer="glorot_uniform", key=key)
        )
    old_keys = jax.random.key_data(keys)
    again = transfer.reinitialise(
        population, initializer="glorot_uniform", key=old_keys, population=True
    )
    assert bits(again) == bits(drawn)
    with pytest.raises(ValueError, match="one for each member"):
        transfer.reinitialise(population, initializer="zeros", key=keys[:2], population=True)


@many
@hypothesis.given(trees(), st.integers(0, 99))
def test_interpolate_goes_from_the_target_to_the_source(target, seed):
    source = like(target, seed)
    at = lambda weight: transfer.interpolate(target, source, weight=weight)  # noqa: E731
    close(at(0.0), target)
    close(at(1.0), source)
    # A quarter of the way: 3/4 target + 1/4 source, exact in multiples of 1/32 below 4.
    for path, leaf in transfer.flatten(at(0.25)).items():
        mine, theirs = (np.asarray(transfer.flatten(t)[path], np.float32) for t in (target, source))
        np.testing.assert_array_equal(leaf, (0.75 * mine + 0.25 * theirs).astype(leaf.dtype))


def test_shrink_perturb_shrinks_and_adds_noise_of_the_given_size():
    source = {"w": jnp.full((200, 200), 3.0)}
    new = transfer.shrink_perturb(source, source, shrink=0.5, noise=0.1, key=KEY)["w"]
    assert abs(new.mean() - 1.5) < 2e-3 and abs(new.std() - 0.1) < 2e-3


def test_take_and_splice_move_part_of_a_kernel():
    # Two features and three actions in the source; two features and one action in the target.
    source = {"w": jnp.arange(10.0).reshape(5, 2)}
    target = {"w": -jnp.ones((3, 2))}
    moved = transfer.splice(target, source, axis="input", indices="0:2")["w"]
    np.testing.assert_array_equal(moved, [[0, 1], [2, 3], [-1, -1]])
    moved = transfer.splice(target, source, axis=-2, indices=[2, 0], source_indices=slice(3, 5))[
        "w"
    ]
    np.testing.assert_array_equal(moved, [[8, 9], [-1, -1], [6, 7]])
    taken = transfer.take(target, source, axis="input", indices=[4, 0, -2])["w"]
    np.testing.assert_array_equal(taken, [[8, 9], [0, 1], [6, 7]])
    with pytest.raises(ValueError, match=r"w: the target has shape \(3, 2\), the source \(2, 2\)"):
        transfer.take(target, source, axis="input", indices="0:2")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"axis": "rows", "indices": "0:1"}, "Axis 'rows' is not known"),
        ({"axis": 0, "indices": "0:1"}, "count from the end"),
        ({"axis": -3, "indices": "0:1"}, "no axis -3"),
        ({"axis": -2, "indices": "0:4"}, "beyond an axis of size 3"),
        ({"axis": -2, "indices": [3]}, "beyond an axis of size 3"),
        ({"axis": -2, "indices": [0, -3]}, "a position twice"),
        ({"axis": -2, "indices": [0, 1], "source_indices": [0]}, "2 positions .* 1 of the source"),
        ({"axis": -1, "indices": "0:1"}, "may differ in axis 1 only"),
    ],
)
def test_splice_refuses_positions_that_make_no_sense(arguments, message):
    with pytest.raises(ValueError, match=message):
        transfer.splice({"w": jnp.ones((3, 2))}, {"w": jnp.ones((5, 2))}, **arguments)


@pytest.mark.parametrize("groups", [1, 2])
@pytest.mark.parametrize(("small", "more"), [(1, 2), (3, 0)])
def test_crop_undoes_pad_for_kernels_and_biases_alone_and_stacked(groups, small, more):
    large = small + more
    source = {
        "kernel": jnp.arange(3.0 * small * groups).reshape(3, -1),
        "bias": jnp.ones(small * groups),
    }
    target = {"kernel": -jnp.ones((3, large * groups)), "bias": -jnp.ones(large * groups)}
    padded = transfer.pad(target, source, axis="output", groups=groups)
    assert bits(transfer.crop(source, padded, axis="output", groups=groups)) == bits(source)
    filling = padded["kernel"].reshape(3, groups, large)[:, :, small:]
    assert (filling == -1).all()
    zeros = transfer.pad(target, source, axis="output", groups=groups, fill=0.0)
    assert (zeros["kernel"].reshape(3, groups, large)[:, :, small:] == 0).all()
    stacked = transfer.pad(
        transfer.replicate(target, size=2),
        transfer.replicate(source, size=2),
        axis="output",
        groups=groups,
    )
    assert bits(transfer.unstack(stacked)[1]) == bits(padded)


def test_pad_and_crop_name_each_other_where_the_sizes_are_the_wrong_way_round():
    small, large = {"b": jnp.ones(2)}, {"b": jnp.ones(5)}
    with pytest.raises(ValueError, match="target has 2 and the source 5; use crop"):
        transfer.pad(small, large, axis=-1)
    with pytest.raises(ValueError, match="target has 5 and the source 2; use pad"):
        transfer.crop(large, small, axis=-1)
    with pytest.raises(ValueError, match="2 groups do not divide the sizes 5 and 2"):
        transfer.pad(large, small, axis=-1, groups=2)


def test_average_is_the_weighted_mean():
    target = {"w": jnp.zeros(2)}
    sources = [{"w": jnp.array([1.0, 2.0])}, {"w": jnp.array([3.0, 6.0])}]
    np.testing.assert_allclose(transfer.average(target, sources)["w"], [2, 4])
    np.testing.assert_allclose(transfer.average(target, sources, weights=[3, 1])["w"], [1.5, 3])
    with pytest.raises(ValueError, match=r"w: weights has shape \(1,\); .* each of 2 sources"):
        transfer.average(target, sources, weights=[1.0])
    with pytest.raises(ValueError, match="at least one source"):
        transfer.average(target, [])


def test_stack_refuses_trees_that_differ():
    with pytest.raises(ValueError, match="structure of tree 1"):
        transfer.stack([{"a": jnp.ones(1)}, {"b": jnp.ones(1)}])
    with pytest.raises(ValueError, match=r"a: float32 \(1,\) in tree 0, float32 \(2,\) in"):
        transfer.stack([{"a": jnp.ones(1)}, {"a": jnp.ones(2)}])
    with pytest.raises(ValueError, match=r"a: float32 \(1,\) in tree 0, int32 \(1,\) in"):
        transfer.stack([{"a": jnp.ones(1)}, {"a": jnp.ones(1, jnp.int32)}])
    with pytest.raises(ValueError, match="share a leading axis"):
        transfer.unstack({"a": jnp.ones(2), "b": jnp.ones(3)})


def test_a_mask_of_another_tree_is_refused():
    with pytest.raises(ValueError, match="structure of the mask"):
        transfer.copy({"a": jnp.ones(1)}, {"a": jnp.ones(1)}, where={"b": True})


def test_dataclasses_are_trees_too():
    @jax.tree_util.register_dataclass
    @dataclasses.dataclass
    class Net:
        w: jax.Array
        b: jax.Array

    net = transfer.copy(Net(jnp.zeros(1), jnp.zeros(1)), {"w": jnp.ones(1)}, where="w")
    assert isinstance(net, Net) and net.w == 1 and net.b == 0
