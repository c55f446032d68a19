"""The memory of an optimiser moved by the plan of the parameters."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import transfer
from transfer import Plan, Rule, apply_to_optimizer
from transfer_trees import bits

ADAM = optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(1e-2))
SOURCE = {"enc": {"w": jnp.ones((3, 2)), "b": jnp.ones(2)}, "out": {"w": jnp.ones((2, 4))}}


@functools.partial(jax.jit, static_argnames=("optimizer", "steps"))
def trained(optimizer, params, steps=3):
    state = optimizer.init(params)
    for step in range(steps):
        gradient = jax.tree.map(lambda x, step=step: (step + 1.0) * jnp.ones_like(x) / 7, params)
        updates, state = optimizer.update(gradient, state, params)
        params = optax.apply_updates(params, updates)
    return params, state


PARAMS, STATE = trained(ADAM, SOURCE)
WHOLE = Plan((Rule("**", "copy"),))


def test_a_copied_run_goes_on_as_if_it_had_not_been_moved():
    target = jax.tree.map(jnp.zeros_like, SOURCE)
    new, _ = transfer.apply(WHOLE, target, PARAMS)
    state, done = apply_to_optimizer(WHOLE, target, ADAM.init(new), STATE)
    assert bits(state) == bits(STATE) and set(done.values()) == {"copied", "source's count"}
    gradient = jax.tree.map(jnp.ones_like, new)
    moved, stayed = ADAM.update(gradient, state, new), ADAM.update(gradient, STATE, PARAMS)
    assert bits(moved) == bits(stayed)


def test_memory_follows_names_layouts_and_sizes():
    target = {"first": {"w": jnp.zeros((2, 3))}, "out": {"w": jnp.zeros((2, 6))}}
    plan = Plan(
        (
            Rule("first/{n}", "copy", source="enc/{n}", layout="transpose"),
            Rule("out/w", "pad", {"axis": "output", "fill": 9.0}),
        )
    )
    state, done = apply_to_optimizer(plan, target, ADAM.init(target), STATE)
    for slot in ("mu", "nu"):
        new, old = getattr(state[1][0], slot), getattr(STATE[1][0], slot)
        np.testing.assert_array_equal(new["first"]["w"], old["enc"]["w"].T)
        np.testing.assert_array_equal(new["out"]["w"][:, :4], old["out"]["w"])
        assert (new["out"]["w"][:, 4:] == 0).all()
    assert state[1][0].count == STATE[1][0].count
    assert done["1/0/mu/first/w"] == "copied"


def test_moments_are_scaled_as_the_gradients_are():
    state, done = apply_to_optimizer(
        WHOLE, SOURCE, ADAM.init(SOURCE), STATE, moments="scale", scale=0.5
    )
    adam, old = state[1][0], STATE[1][0]
    np.testing.assert_allclose(adam.mu["enc"]["w"], 0.5 * old.mu["enc"]["w"], rtol=1e-6)
    np.testing.assert_allclose(adam.nu["enc"]["w"], 0.25 * old.nu["enc"]["w"], rtol=1e-6)
    # Adam's step does not depend on the size of gradients, so it is the same as before.
    gradient = jax.tree.map(jnp.ones_like, SOURCE)
    half = jax.tree.map(lambda x: x / 2, gradient)
    inner = optax.scale_by_adam(eps=0.0)
    a, _ = inner.update(half, adam, SOURCE)
    b, _ = inner.update(gradient, old, SOURCE)
    np.testing.assert_allclose(a["enc"]["w"], b["enc"]["w"], rtol=1e-5)
    assert done["1/0/nu/enc/w"] == "scaled"


def test_what_is_fresh_has_fresh_memory_and_counts_must_then_be_said():
    plan = Plan((Rule("enc/*", "copy"), Rule("out/*", "fraction", {"omega": 0.5})))
    fresh = ADAM.init(SOURCE)
    with pytest.raises(ValueError, match="memory of 4 of 6 leaves was moved .* say counts="):
        apply_to_optimizer(plan, SOURCE, fresh, STATE)
    for counts, expected in (("source", 3), ("target", 0)):
        state, done = apply_to_optimizer(plan, SOURCE, fresh, STATE, counts=counts)
        adam = state[1][0]
        assert adam.count == expected and done["1/0/count"] == f"{counts}'s count"
        assert (adam.mu["out"]["w"] == 0).all() and done["1/0/mu/out/w"] == "reset"
        assert bits(adam.mu["enc"]) == bits(STATE[1][0].mu["enc"])
    state, done = apply_to_optimizer(WHOLE, SOURCE, fresh, STATE, moments="reset")
    assert bits(state) == bits(fresh) and "copied" not in done.values()
    kept, _ = apply_to_optimizer(Plan((), default="keep"), SOURCE, fresh, STATE)
    assert bits(kept) == bits(fresh)


def test_frozen_leaves_and_momentum_are_understood():
    optimizer = transfer.freeze(optax.sgd(0.1, momentum=0.9), "enc/**")
    _, old = trained(optimizer, SOURCE)
    state, done = apply_to_optimizer(WHOLE, SOURCE, optimizer.init(SOURCE), old)
    assert bits(state) == bits(old)
    assert [path for path in done if path.endswith("out/w")] and not any("enc" in p for p in done)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"moments": "half"}, "moments is 'copy', 'scale' or 'reset'"),
        ({"scale": 0.5}, "scale belongs to moments='scale'"),
        ({"moments": "scale"}, "scale belongs to moments='scale'"),
        ({"moments": "scale", "scale": -1.0}, "scale is -1; expected numbers of 0 or more"),
    ],
)
def test_misuse_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        apply_to_optimizer(WHOLE, SOURCE, ADAM.init(SOURCE), STATE, **arguments)
    other = optax.sgd(0.1).init(SOURCE)
    with pytest.raises(ValueError, match="source has no leaf '1/0/mu"):
        apply_to_optimizer(WHOLE, SOURCE, ADAM.init(SOURCE), other)
    named = Plan((Rule("**", "copy", source="one"),))
    with pytest.raises(ValueError, match="plans of one source"):
        apply_to_optimizer(named, SOURCE, ADAM.init(SOURCE), STATE)
