"""Leaves that do not train, train later, or train slower."""

import equinox as eqx
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx
from hypothesis import strategies as st

import transfer
from transfer.freeze import combine, partition
from transfer_trees import NnxNet, bits, library_tree, trees

PARAMS = {
    "encoder": {"kernel": np.float32([1.0, -0.0, -2.0]), "bias": np.float32([0.5])},
    "head": {"kernel": np.float32([3.0, 4.0])},
}
GRADIENTS = jax.tree.map(lambda x: np.full_like(x, 0.7), PARAMS)

# Everything that moves a parameter although its gradient is zero, or remembers it.
STUBBORN = {
    "weight decay": optax.adamw(0.1, weight_decay=0.5),
    "momentum": optax.sgd(0.1, momentum=0.9, nesterov=True),
    "adam": optax.adam(0.1),
    "trust ratio": optax.lamb(0.1, weight_decay=0.1),
}


def train(optimizer, params, steps, gradients=GRADIENTS):
    """The parameters after each of a number of steps."""

    @jax.jit
    def step(params, state):
        updates, state = optimizer.update(gradients, state, params)
        return optax.apply_updates(params, updates), state

    state, history = jax.jit(optimizer.init)(params), []
    for _ in range(steps):
        params, state = step(params, state)
        history.append(params)
    return history


def same(tree, expected):
    """Equal but for the last bit, which the compiler may round differently in another program."""
    for path, leaf in transfer.flatten(tree).items():
        np.testing.assert_allclose(leaf, transfer.flatten(expected)[path], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", STUBBORN)
def test_frozen_leaves_do_not_move_by_a_bit_and_the_others_train_as_ever(name):
    frozen = train(transfer.freeze(STUBBORN[name], "encoder/**"), PARAMS, 5)
    alone = train(STUBBORN[name], {"head": PARAMS["head"]}, 5, {"head": GRADIENTS["head"]})
    for params, expected in zip(frozen, alone, strict=True):
        assert bits(params["encoder"]) == bits(PARAMS["encoder"])
        same(params["head"], expected["head"])


@pytest.mark.parametrize("name", STUBBORN)
def test_frozen_leaves_cost_no_memory_of_the_optimizer(name):
    size = lambda state: sum(x.size for x in jax.tree.leaves(state))  # noqa: E731
    frozen = transfer.freeze(STUBBORN[name], "encoder/**").init(PARAMS)
    assert size(frozen) == size(STUBBORN[name].init({"head": PARAMS["head"]}))


def test_a_global_norm_inside_counts_trained_leaves_only():
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.sgd(1.0))
    gradients = {"encoder": jnp.array([1e6]), "head": jnp.array([3.0, 4.0])}
    params = jax.tree.map(jnp.zeros_like, gradients)
    (moved,) = train(transfer.freeze(optimizer, "encoder"), params, 1, gradients)
    np.testing.assert_allclose(moved["head"], [-0.6, -0.8], rtol=1e-6)


def test_masks_freeze_as_patterns_do_and_unknown_patterns_are_refused():
    by_mask = transfer.freeze(optax.adam(0.1), transfer.select(PARAMS, "encoder/**"))
    by_pattern = transfer.freeze(optax.adam(0.1), ["encoder/**"])
    assert bits(train(by_mask, PARAMS, 2)[-1]) == bits(train(by_pattern, PARAMS, 2)[-1])
    with pytest.raises(ValueError, match=r"'encodr/\*\*' matches no leaf.*encoder"):
        transfer.freeze(optax.adam(0.1), "encodr/**").init(PARAMS)


def test_freezing_works_for_every_member_of_a_population_under_vmap():
    optimizer = transfer.freeze(optax.adamw(0.1, weight_decay=0.5), "encoder/**")
    population = transfer.replicate(PARAMS, size=3)
    gradients = transfer.replicate(GRADIENTS, size=3)

    @jax.jit
    @jax.vmap
    def moved_once(params, gradients):
        updates, _ = optimizer.update(gradients, optimizer.init(params), params)
        return optax.apply_updates(params, updates)

    moved = moved_once(population, gradients)
    assert bits(moved["encoder"]) == bits(population["encoder"])
    assert (moved["head"]["kernel"] != population["head"]["kernel"]).all()


def test_freezing_works_in_an_equinox_training_step():
    model = library_tree("equinox")
    params, static = eqx.partition(model, eqx.is_array)
    optimizer = transfer.freeze(optax.adamw(0.1, weight_decay=0.5), "layers/0/*")
    loss = lambda params: (eqx.combine(params, static)(jnp.ones(4)) ** 2).sum()  # noqa: E731

    @eqx.filter_jit
    def step(params):
        updates, _ = optimizer.update(jax.grad(loss)(params), optimizer.init(params), params)
        return eqx.apply_updates(params, updates)

    moved = step(params)
    assert bits(moved.layers[0]) == bits(model.layers[0])
    assert (moved.layers[1].weight != model.layers[1].weight).all()


def test_freezing_works_in_an_nnx_training_step():
    model = NnxNet(nnx.Rngs(0))
    before = bits(nnx.state(model))
    optimizer = nnx.Optimizer(model, transfer.freeze(optax.adam(0.1), "hidden/*"), wrt=nnx.Param)

    def loss(model):
        return ((model.out(model.hidden(jnp.ones((1, 4)))) - 1) ** 2).sum()

    @nnx.jit
    def step(model, optimizer):
        optimizer.update(model, nnx.grad(loss)(model))

    step(model, optimizer)
    after = bits(nnx.state(model))
    assert {path for path in before if before[path] != after[path]} == {"out/kernel", "out/bias"}


# --- unfreezing -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", STUBBORN)
def test_a_leaf_waits_untouched_and_then_trains_as_from_a_fresh_start(name):
    optimizer = transfer.unfreeze_gradually(STUBBORN[name], {"encoder/**": 3})
    history = train(optimizer, PARAMS, 6)
    only = lambda part: ({part: PARAMS[part]}, {part: GRADIENTS[part]})  # noqa: E731
    encoder, encoder_gradients = only("encoder")
    head, head_gradients = only("head")
    for params in history[:3]:
        assert bits(params["encoder"]) == bits(PARAMS["encoder"])
    expected = train(STUBBORN[name], encoder, 3, encoder_gradients)
    for params, alone in zip(history[3:], expected, strict=True):
        same(params["encoder"], alone["encoder"])
    for params, alone in zip(history, train(STUBBORN[name], head, 6, head_gradients), strict=True):
        same(params["head"], alone["head"])


def test_layers_can_be_unfrozen_one_after_another():
    optimizer = transfer.unfreeze_gradually(
        optax.sgd(0.1), {"encoder/kernel": 2, "encoder/bias": 1}
    )
    moved = [
        {path for path, value in bits(params).items() if value != bits(PARAMS)[path]}
        for params in train(optimizer, PARAMS, 3)
    ]
    assert moved == [
        {"head/kernel"},
        {"head/kernel", "encoder/bias"},
        {"head/kernel", "encoder/bias", "encoder/kernel"},
    ]


def test_a_leaf_named_by_two_patterns_is_refused():
    for wrap in (transfer.unfreeze_gradually, transfer.scale_learning_rates):
        optimizer = wrap(optax.sgd(0.1), {"encoder/**": 1, "**/kernel": 2})
        with pytest.raises(ValueError, match="encoder/kernel is named by two patterns"):
            optimizer.update(PARAMS, optimizer.init(PARAMS), PARAMS)


# --- learning rates ---------------------------------------------------------------------------


def test_multipliers_scale_the_whole_update_of_their_leaves():
    plain = optax.adamw(0.1, weight_decay=0.5)
    scaled = transfer.scale_learning_rates(plain, {"encoder/kernel": 0.5, "head/*": 2.0})
    updates, found = (
        jax.jit(lambda p, g, each=each: each.update(g, each.init(p), p)[0])(PARAMS, GRADIENTS)
        for each in (plain, scaled)
    )
    expected = {
        "encoder": {
            "kernel": updates["encoder"]["kernel"] * 0.5,
            "bias": updates["encoder"]["bias"],
        },
        "head": {"kernel": updates["head"]["kernel"] * 2.0},
    }
    same(found, expected)


def test_multipliers_can_differ_between_members_of_a_population():
    def first_update(factor):
        optimizer = transfer.scale_learning_rates(optax.sgd(1.0), {"head/*": factor})
        return optimizer.update(GRADIENTS, optimizer.init(PARAMS), PARAMS)[0]

    updates = jax.vmap(first_update)(jnp.array([0.5, 1.0]))
    np.testing.assert_allclose(updates["head"]["kernel"], [[-0.35, -0.35], [-0.7, -0.7]])


# --- gradients --------------------------------------------------------------------------------


@hypothesis.settings(max_examples=30, deadline=None)
@hypothesis.given(trees(), st.data())
def test_combine_undoes_partition(tree, data):
    chosen = data.draw(st.sets(st.sampled_from(transfer.paths(tree))))
    first, rest = partition(tree, transfer.select(tree, *chosen) if chosen else _nothing(tree))
    assert set(transfer.paths(first)) == chosen
    assert set(transfer.paths(rest)) == set(transfer.paths(tree)) - chosen
    again = combine(first, rest)
    assert jax.tree.structure(again) == jax.tree.structure(tree)
    assert bits(again) == bits(tree)


def _nothing(tree):
    return jax.tree.map(lambda _: False, tree)


def test_partition_keeps_settings_with_the_rest():
    module = eqx.nn.MLP(2, 1, 3, 1, activation=jnp.tanh, key=jax.random.key(0))
    frozen, rest = partition(module, "layers/0/*")
    assert frozen.activation is None and rest.activation is jnp.tanh
    assert combine(frozen, rest)(jnp.ones(2)) == module(jnp.ones(2))


def test_combine_refuses_parts_that_overlap():
    with pytest.raises(ValueError, match="found one in 2"):
        combine({"a": 1.0}, {"a": 2.0})


def test_the_gradient_of_a_partition_computes_nothing_for_the_frozen_part():
    size = 64
    params = {name: jnp.ones((size, size)) for name in ("encoder", "head")}

    def loss(params):
        return (jnp.tanh(jnp.ones((1, size)) @ params["encoder"]) @ params["head"]).sum()

    def products(function, *arguments):
        return str(jax.make_jaxpr(function)(*arguments)).count("dot_general")

    frozen, trained = partition(params, "encoder")
    part = jax.grad(lambda trained: loss(combine(trained, frozen)))
    # Two products forward; backward one for head, and for encoder one more through head.
    assert products(part, trained) == 3
    assert products(jax.grad(loss), params) == 5
    assert part(trained)["encoder"] is None


def test_stop_gradient_leaves_values_and_zeroes_gradients_of_the_selection():
    loss = lambda tree: sum((x**2).sum() for x in jax.tree.leaves(tree))  # noqa: E731
    stopped = lambda tree: loss(transfer.stop_gradient(tree, "encoder/**"))  # noqa: E731
    assert stopped(PARAMS) == loss(PARAMS)
    gradients = jax.grad(stopped)(PARAMS)
    assert all((x == 0).all() for x in jax.tree.leaves(gradients["encoder"]))
    np.testing.assert_array_equal(gradients["head"]["kernel"], [6, 8])
