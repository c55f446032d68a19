"""A head over the predictions of frozen heads."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import transfer
from transfer.ltc import NOVEL
from transfer.meta_model import meta_inputs, predictions, store, switch
from transfer_trees import bits

M, HIDDEN = 5, 7
FEATURES = jnp.asarray(np.random.default_rng(9).standard_normal((3, 4, M)), jnp.float32)


predict = jax.jit(lambda stored, inputs: predictions(apply_head, stored, inputs))
read = jax.jit(lambda stored, inputs: meta_inputs(apply_head, stored, inputs))


def head(seed, outputs=1, inputs=M):
    random = np.random.default_rng(seed)
    return {
        "hidden": jnp.asarray(random.standard_normal((inputs, HIDDEN)), jnp.float32),
        "out": jnp.asarray(random.standard_normal((HIDDEN, outputs)), jnp.float32),
        "bias": jnp.ones(outputs),
    }


def apply_head(params, inputs):
    return jnp.tanh(inputs @ params["hidden"]) @ params["out"] + params["bias"]


HEADS = [head(seed) for seed in range(4)]


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_predictions_are_those_of_each_head_and_zero_where_there_is_none(count):
    stored = store(HEADS[:count], size=4)
    found = predict(stored, FEATURES)
    assert found.shape == (3, 4, 4, 1)
    for place in range(4):
        expected = apply_head(HEADS[place], FEATURES) if place < count else 0.0
        np.testing.assert_allclose(found[..., place, :], expected * jnp.ones((3, 4, 1)), rtol=1e-6)


def test_the_meta_model_reads_the_features_first_and_then_head_by_head():
    stored = store([head(seed, outputs=2) for seed in range(3)], size=4)
    inputs = read(stored, FEATURES)
    assert inputs.shape == (3, 4, M + 4 * 2)
    np.testing.assert_array_equal(inputs[..., :M], FEATURES)
    found = predict(stored, FEATURES)
    np.testing.assert_array_equal(inputs[..., M + 2 : M + 4], found[..., 1, :])
    assert (inputs[..., -2:] == 0).all()


def test_a_head_may_read_several_inputs_and_the_meta_model_others():
    def apply_dynamics(params, inputs):
        state, action = inputs
        return apply_head(params, jnp.concatenate([state, action], -1))

    stored = store([head(2, outputs=M, inputs=M + 2)])
    action = jnp.ones((3, 4, 2))
    run = jax.jit(lambda *inputs: meta_inputs(apply_dynamics, stored, inputs, context=inputs[0]))
    inputs = run(FEATURES, action)
    expected = jax.jit(apply_dynamics)(head(2, M, M + 2), (FEATURES, action))
    np.testing.assert_allclose(inputs[..., M:], expected, rtol=1e-6)


def test_the_gradient_passes_through_frozen_heads_into_features_never_into_parameters():
    stored = store(HEADS[:2], size=4)
    total = lambda stored, features: meta_inputs(apply_head, stored, features).sum()  # noqa: E731
    into_heads, into_features = jax.jit(jax.grad(total, argnums=(0, 1), allow_int=True))(
        stored, FEATURES
    )
    assert all((leaf == 0).all() for leaf in jax.tree.leaves(into_heads.params))
    alone = lambda x: x.sum() + sum(apply_head(p, x).sum() for p in HEADS[:2])  # noqa: E731
    np.testing.assert_allclose(into_features, jax.jit(jax.grad(alone))(FEATURES), rtol=1e-5)
    assert (abs(into_features - 1) > 1e-3).any()


def test_places_that_are_not_present_give_finite_gradients_whatever_the_head_does_at_zero():
    fragile = lambda params, x: jnp.log(jnp.sum(params["w"] * x, -1, keepdims=True))  # noqa: E731
    stored = store([{"w": jnp.ones(M)}], size=2)
    gradient = jax.jit(jax.grad(lambda x: predictions(fragile, stored, x).sum()))(jnp.ones(M))
    assert jnp.isfinite(gradient).all()


def test_frozen_heads_do_not_move_by_a_bit_in_a_thousand_updates():
    stored = store(HEADS[:3], size=4)
    meta = head(3, inputs=M + 4)
    optimizer = optax.adamw(1e-2, weight_decay=0.1)
    target = jnp.sin(3 * FEATURES.sum(-1, keepdims=True))

    def loss(meta, stored):
        error = apply_head(meta, meta_inputs(apply_head, stored, FEATURES)) - target
        return (error**2).mean()

    @jax.jit
    def train(meta, stored):
        def step(carry, _):
            meta, state = carry
            value, gradient = jax.value_and_grad(loss)(meta, stored)
            updates, state = optimizer.update(gradient, state, meta)
            return (optax.apply_updates(meta, updates), state), value

        (meta, _), values = jax.lax.scan(step, (meta, optimizer.init(meta)), length=1000)
        return meta, stored, values

    before = bits(stored)
    _, after, values = train(meta, stored)
    assert bits(after) == before
    assert values[-1] < 0.1 * values[0]


def test_the_gradient_is_the_same_where_the_heads_are_left_trainable_by_mistake():
    stored = store(HEADS[:2])
    loss = lambda stored: predictions(apply_head, stored, FEATURES).sum()  # noqa: E731
    moved = jax.tree.map(
        lambda x, g: x - g if x.dtype == jnp.float32 else x,
        stored,
        jax.jit(jax.grad(loss, allow_int=True))(stored),
    )
    assert bits(moved) == bits(stored)


def test_targets_with_different_numbers_of_sources_are_one_population():
    stored = [store(HEADS[:count], size=4) for count in (2, 3, 4)]
    population = transfer.stack(stored)
    features = jnp.stack([FEATURES, FEATURES + 1, FEATURES - 1])
    run = lambda stored, x: meta_inputs(apply_head, stored, x)  # noqa: E731
    mapped = jax.jit(jax.vmap(run))(population, features)
    for index, one in enumerate(stored):
        np.testing.assert_allclose(mapped[index], read(one, features[index]), rtol=1e-5, atol=1e-6)


def test_stored_heads_survive_a_file(tmp_path):
    stored = store(HEADS[:2], size=3)
    transfer.save(tmp_path / "heads.npz", stored)
    again = transfer.copy(store(HEADS[2:], size=3), transfer.load(tmp_path / "heads.npz"))
    assert bits(again) == bits(stored)


def test_heads_that_do_not_go_together_are_refused():
    with pytest.raises(ValueError, match="Got 0 heads to store in 4 places"):
        store([], size=4)
    with pytest.raises(ValueError, match="Got 3 heads to store in 2 places"):
        store(HEADS[:3], size=2)
    with pytest.raises(ValueError, match=r"bias: float32 \(1,\) in tree 0, float32 \(2,\)"):
        store([HEADS[0], head(0, outputs=2)])


def test_switching_uses_the_stored_head_of_a_known_task_and_the_meta_model_for_a_novel_one():
    found = predict(store(HEADS[:2], size=4), FEATURES[0])
    meta = jnp.full((4, 1), 9.0)
    labels = jnp.array([1, NOVEL, 0, 1])
    chosen = jax.jit(switch)(labels, found, meta)
    np.testing.assert_array_equal(chosen[1], [9])
    for place, label in ((0, 1), (2, 0), (3, 1)):
        np.testing.assert_array_equal(chosen[place], found[place, label])
