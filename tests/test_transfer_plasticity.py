"""Periodic resets and dormant units, by hand and against a network's own outputs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import transfer
from transfer_trees import bits

KEY = jax.random.key(0)


def layers(seed, units=6):
    random = np.random.default_rng(seed)
    draw = lambda *shape: random.normal(size=shape).astype(np.float32)  # noqa: E731
    return {
        "hidden": {"kernel": draw(4, units), "bias": draw(units)},
        "out": {"kernel": draw(units, 2), "bias": np.zeros(2, np.float32)},
    }


@jax.jit
def activations(params, x):
    return jax.nn.relu(x @ params["hidden"]["kernel"] + params["hidden"]["bias"])


@jax.jit
def outputs(params, x):
    return activations(params, x) @ params["out"]["kernel"] + params["out"]["bias"]


def test_resets_come_every_period_until_they_end():
    tree, fresh = layers(0), layers(1)

    def step(tree, number):
        new = transfer.reset_periodically(
            tree, fresh, step=number, period=3, until=7, where="out/*"
        )
        return tree, (new["out"]["kernel"] == fresh["out"]["kernel"]).all()

    assert jax.lax.scan(step, tree, jnp.arange(10))[1].tolist() == [s in (3, 6) for s in range(10)]
    new = transfer.reset_periodically(tree, fresh, step=3, period=3, where="out/*")
    assert bits(new["hidden"]) == bits(tree["hidden"]) and bits(new["out"]) == bits(fresh["out"])
    adam = optax.adam(1.0)
    begun = jax.jit(adam.init)(tree)
    used = jax.jit(adam.update)(tree, begun, tree)[1]
    state = transfer.reset_periodically(used, begun, step=3, period=3, where="0/*/out/*")
    assert not np.any(state[0].mu["out"]["kernel"]) and not np.any(state[0].nu["out"]["kernel"])
    assert bits(state[0].mu["hidden"]) == bits(used[0].mu["hidden"]) and state[0].count == 1
    with pytest.raises(ValueError, match="1 or more; got 0"):
        transfer.reset_periodically(tree, fresh, step=3, period=0, where="out/*")


def test_scores_are_shares_of_the_layers_mean_activity():
    h = jnp.array([[1.0, -1.0, 0.0, 4.0], [3.0, 1.0, 0.0, 0.0]])
    # Means of |h| are 2, 1, 0 and 2: their mean is 1.25.
    np.testing.assert_allclose(transfer.dormancy(h), [1.6, 0.8, 0, 1.6], rtol=1e-6)
    image = jnp.broadcast_to(h[:, None, None, :], (2, 3, 5, 4))
    np.testing.assert_allclose(transfer.dormancy(image), [1.6, 0.8, 0, 1.6], rtol=1e-6)
    assert transfer.dormant_units(h, threshold=0.8).tolist() == [False, True, True, False]
    assert (transfer.dormancy(jnp.zeros((3, 4))) == 0).all()
    with pytest.raises(ValueError, match="threshold is -1"):
        transfer.dormant_units(h, threshold=-1)


def test_recycling_silent_units_leaves_the_function_and_lets_them_learn():
    params, x = layers(0), np.random.default_rng(0).normal(size=(32, 4)).astype(np.float32)
    # Units 1 and 4 never fire.
    params["hidden"]["bias"] = np.float32([1, -100, 1, 1, -100, 1])
    dormant = transfer.dormant_units(activations(params, x))
    assert dormant.tolist() == [False, True, False, False, True, False]
    fresh = layers(1)

    @jax.jit
    def restart(params, dormant):
        return transfer.recycle(params, fresh, dormant, incoming="hidden/*", outgoing="out/kernel")

    new = restart(params, dormant)
    np.testing.assert_array_equal(outputs(new, x), outputs(params, x))
    silent = np.asarray(dormant)
    for path, axis in (("kernel", 1), ("bias", 0)):
        leaf, expected, old = (
            np.moveaxis(np.asarray(tree["hidden"][path]), axis, 0) for tree in (new, fresh, params)
        )
        assert (leaf[silent] == expected[silent]).all() and (leaf[~silent] == old[~silent]).all()
    assert (np.asarray(new["out"]["kernel"])[silent] == 0).all()
    assert bits(new["out"])["bias"] == bits(params["out"])["bias"]
    assert not np.all(transfer.dormant_units(activations(new, x)))
    gradient = jax.jit(jax.grad(lambda p: (outputs(p, x) ** 2).sum()))(new)
    assert np.any(np.asarray(gradient["out"]["kernel"])[silent])


def test_layouts_of_other_libraries_and_flattened_channels():
    make = eqx.filter_jit(lambda key: eqx.nn.MLP(4, 2, 6, 1, key=key))
    mlp, fresh = make(KEY), make(jax.random.key(1))
    dormant = np.arange(6) == 2
    new = transfer.recycle(
        mlp,
        fresh,
        dormant,
        incoming="layers/0/*",
        outgoing="layers/1/weight",
        incoming_axis=-2,
        outgoing_axis=-1,
    )
    new, fresh = (jax.tree.map(np.asarray, eqx.filter(x, eqx.is_array)) for x in (new, fresh))
    assert (new.layers[0].weight[2] == fresh.layers[0].weight[2]).all()
    assert new.layers[0].bias[2] == fresh.layers[0].bias[2]
    assert (new.layers[1].weight[:, 2] == 0).all() and (new.layers[1].weight[:, 3] != 0).all()
    # A convolution of 3 channels whose 2 x 2 image is flattened, channels last.
    tree = {"conv": np.ones((3, 3, 1, 3)), "dense": np.ones((12, 5))}
    tree = jax.tree.map(np.float32, tree)
    new = transfer.recycle(
        tree, tree, np.array([False, True, False]), incoming="conv", outgoing="dense"
    )
    assert np.asarray(new["dense"])[:, 0].tolist() == [1, 0, 1] * 4
    for flags, message in (
        (jnp.ones(5, bool), "conv: axis 3 has size 3, and there are 5 units"),
        (jnp.ones((1, 3), bool), r"dormant has shape \(1, 3\)"),
    ):
        with pytest.raises(ValueError, match=message):
            transfer.recycle(tree, tree, flags, incoming="conv", outgoing="dense")
    with pytest.raises(ValueError, match="conv is incoming and outgoing both"):
        transfer.recycle(tree, tree, dormant, incoming="*", outgoing="conv")


def test_each_member_of_a_population_recycles_its_own_units():
    tree = {"h": jnp.ones((2, 2)), "out": jnp.ones((2, 1))}
    population = transfer.replicate(tree, size=3)
    fresh = transfer.replicate({"h": jnp.zeros((2, 2))}, size=3)
    dormant = jnp.array([[True, False], [False, False], [False, True]])
    recycle = lambda t, f, d: transfer.recycle(t, f, d, incoming="h", outgoing="out")  # noqa: E731
    new = jax.vmap(recycle)(population, fresh, dormant)
    assert new["out"][..., 0].tolist() == [[0, 1], [1, 1], [1, 0]]
