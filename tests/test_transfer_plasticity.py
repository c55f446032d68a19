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


def layers(key, units=6):
    keys = jax.random.split(key, 3)
    draw = jax.nn.initializers.he_normal()
    return {
        "hidden": {
            "kernel": draw(keys[0], (4, units)),
            "bias": jax.random.normal(keys[1], (units,)),
        },
        "out": {"kernel": draw(keys[2], (units, 2)), "bias": jnp.zeros(2)},
    }


def activations(params, x):
    return jax.nn.relu(x @ params["hidden"]["kernel"] + params["hidden"]["bias"])


def outputs(params, x):
    return activations(params, x) @ params["out"]["kernel"] + params["out"]["bias"]


def test_resets_come_every_period_until_they_end():
    tree, fresh = layers(KEY), layers(jax.random.key(1))

    def step(tree, number):
        new = transfer.reset_periodically(
            tree, fresh, step=number, period=3, until=7, where="out/*"
        )
        return tree, (new["out"]["kernel"] == fresh["out"]["kernel"]).all()

    assert jax.lax.scan(step, tree, jnp.arange(10))[1].tolist() == [s in (3, 6) for s in range(10)]
    new = transfer.reset_periodically(tree, fresh, step=3, period=3, where="out/*")
    assert bits(new["hidden"]) == bits(tree["hidden"]) and bits(new["out"]) == bits(fresh["out"])
    adam = optax.adam(1.0)
    used = adam.update(tree, adam.init(tree), tree)[1]
    state = transfer.reset_periodically(used, adam.init(tree), step=3, period=3, where="0/*/out/*")
    assert (state[0].mu["out"]["kernel"] == 0).all() and (state[0].nu["out"]["kernel"] == 0).all()
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
    params, x = layers(KEY), jax.random.normal(KEY, (32, 4))
    # Units 1 and 4 never fire.
    params["hidden"]["bias"] = jnp.array([1.0, -100.0, 1.0, 1.0, -100.0, 1.0])
    dormant = transfer.dormant_units(activations(params, x))
    assert dormant.tolist() == [False, True, False, False, True, False]
    fresh = layers(jax.random.key(1))

    @jax.jit
    def restart(params, dormant):
        return transfer.recycle(params, fresh, dormant, incoming="hidden/*", outgoing="out/kernel")

    new = restart(params, dormant)
    np.testing.assert_array_equal(outputs(new, x), outputs(params, x))
    for path, axis in (("kernel", 1), ("bias", 0)):
        leaf = jnp.moveaxis(new["hidden"][path], axis, 0)
        expected = jnp.moveaxis(fresh["hidden"][path], axis, 0)
        old = jnp.moveaxis(params["hidden"][path], axis, 0)
        assert (leaf[dormant] == expected[dormant]).all() and (
            leaf[~dormant] == old[~dormant]
        ).all()
    assert (new["out"]["kernel"][dormant] == 0).all()
    assert bits(new["out"])["bias"] == bits(params["out"])["bias"]
    assert not transfer.dormant_units(activations(new, x)).all()
    gradient = jax.grad(lambda p: (outputs(p, x) ** 2).sum())(new)
    assert (jnp.abs(gradient["out"]["kernel"][dormant]).sum(-1) > 0).any()


def test_layouts_of_other_libraries_and_flattened_channels():
    mlp = eqx.nn.MLP(4, 2, 6, 1, key=KEY)
    fresh = eqx.nn.MLP(4, 2, 6, 1, key=jax.random.key(1))
    dormant = jnp.arange(6) == 2
    new = transfer.recycle(
        mlp,
        fresh,
        dormant,
        incoming="layers/0/*",
        outgoing="layers/1/weight",
        incoming_axis=-2,
        outgoing_axis=-1,
    )
    assert (new.layers[0].weight[2] == fresh.layers[0].weight[2]).all()
    assert new.layers[0].bias[2] == fresh.layers[0].bias[2]
    assert (new.layers[1].weight[:, 2] == 0).all() and (new.layers[1].weight[:, 3] != 0).all()
    # A convolution of 3 channels whose 2 x 2 image is flattened, channels last.
    tree = {"conv": jnp.ones((3, 3, 1, 3)), "dense": jnp.ones((12, 5))}
    new = transfer.recycle(
        tree, tree, jnp.array([False, True, False]), incoming="conv", outgoing="dense"
    )
    assert new["dense"][:, 0].tolist() == [1, 0, 1] * 4
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
