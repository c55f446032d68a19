"""The recurrent state-space model against independent formulas."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dreamer_jax import rssm

B, L, A, E = 3, 6, 2, 10
SIZES = {"stochastic_size": 4, "deterministic_size": 8, "hidden_size": 5}
random = np.random.default_rng(0)


def draws(*shape):
    return jnp.asarray(random.normal(size=shape), jnp.float32)


@pytest.fixture(scope="module")
def model():
    dynamics = rssm.Dynamics(**SIZES, action_size=A, embedding_size=E)
    params = dynamics.init(jax.random.key(0), jnp.zeros((1, E)), jnp.zeros((1, A)))["params"]
    # Biases are drawn at zero; a test of formulas must see them.
    leaves, treedef = jax.tree.flatten(params)
    return dynamics, jax.tree.unflatten(treedef, [x + 0.1 * draws(*x.shape) for x in leaves])


def elu(x):
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def numpy_gru(params, x, h):
    size = h.shape[-1]
    inputs = x @ np.asarray(params["kernel"]) + np.asarray(params["bias"][0])
    recurrent = h @ np.asarray(params["recurrent_kernel"]) + np.asarray(params["bias"][1])
    z = sigmoid(inputs[:, :size] + recurrent[:, :size])
    r = sigmoid(inputs[:, size : 2 * size] + recurrent[:, size : 2 * size])
    n = np.tanh(inputs[:, 2 * size :] + r * recurrent[:, 2 * size :])
    return z * h + (1 - z) * n


def state_of(*shape):
    mean, std = draws(*shape, 4), jnp.exp(draws(*shape, 4))
    return rssm.LatentState(mean, std, draws(*shape, 4), draws(*shape, 8))


def test_the_gru_equals_one_written_in_numpy():
    gru = rssm.GRU(8)
    x, h = draws(B, 5), draws(B, 8)
    params = gru.init(jax.random.key(1), x, h)["params"]
    params = params | {"bias": draws(2, 24)}
    assert_allclose(gru.apply({"params": params}, x, h), numpy_gru(params, x, h), atol=1e-6)


def test_split_kernels_equal_one_dense_layer_on_the_concatenation(model):
    dynamics, params = model
    state, action, noise = state_of(B), draws(B, A), draws(B, 4)
    new = dynamics.apply({"params": params}, state, action, noise, method="img_step")

    stoch_in, action_in = params["stoch_in"], params["action_in"]
    kernel = np.concatenate([stoch_in["kernel"], action_in["kernel"]])
    joined = np.concatenate([state.stochastic, action], axis=-1)
    x = elu(joined @ kernel + np.asarray(stoch_in["bias"]))
    deterministic = numpy_gru(params["gru"], x, np.asarray(state.deterministic))
    assert_allclose(new.deterministic, deterministic, atol=1e-5)

    prior = jax.tree.map(np.asarray, params["prior"])
    hidden = elu(deterministic @ prior["hidden"]["kernel"] + prior["hidden"]["bias"])
    mean, std = np.split(hidden @ prior["out"]["kernel"] + prior["out"]["bias"], 2, axis=-1)
    std = np.log1p(np.exp(std)) + 0.1
    assert_allclose(new.mean, mean, atol=1e-5)
    assert_allclose(new.std, std, atol=1e-5)
    assert_allclose(new.stochastic, mean + std * noise, atol=1e-5)


def test_split_kernels_are_drawn_with_the_fans_of_the_concatenated_one():
    dynamics = rssm.Dynamics(30, 200, 200, action_size=6, embedding_size=E)
    params = jax.jit(dynamics.init)(jax.random.key(0), jnp.zeros((1, E)), jnp.zeros((1, 6)))
    limit = math.sqrt(6 / (36 + 200))
    for name in ("stoch_in", "action_in"):
        largest = jnp.abs(params["params"][name]["kernel"]).max()
        assert 0.98 * limit < largest <= limit


def test_the_posterior_equals_a_dense_layer_on_state_and_embedding(model):
    dynamics, params = model
    variables = {"params": params}
    state, action, embedding = state_of(B), draws(B, A), draws(B, E)
    projected = dynamics.apply(variables, embedding, method="project")
    first = jnp.zeros(B, bool)
    new = dynamics.apply(variables, state, action, projected, first, 0.0, method="obs_step")
    posterior = jax.tree.map(np.asarray, params["posterior"])
    joined = np.concatenate([new.deterministic, embedding], axis=-1)
    hidden = elu(joined @ posterior["hidden"]["kernel"] + posterior["hidden"]["bias"])
    expected = hidden @ posterior["out"]["kernel"] + posterior["out"]["bias"]
    assert_allclose(new.mean, expected[:, :4], atol=1e-5)


def test_a_first_record_makes_the_model_forget_all_before_it(model):
    dynamics, params = model
    embeddings, actions = draws(B, L, E), draws(B, L, A)
    first = jnp.zeros((B, L), bool).at[:, 3].set(True)
    key = jax.random.key(0)

    @jax.jit
    def features(embeddings, actions):
        return rssm.observe(dynamics, params, embeddings, actions, first, key)[0].features

    changed = features(embeddings.at[:, :3].add(1.0), actions.at[:, :3].add(1.0).at[:, 3].add(5.0))
    original = features(embeddings, actions)
    assert_array_equal(changed[:, 3:], original[:, 3:])
    assert not jnp.allclose(changed[:, :3], original[:, :3])


def test_without_a_first_record_the_model_remembers(model):
    dynamics, params = model
    embeddings, actions = draws(B, L, E), draws(B, L, A)
    first, key = jnp.zeros((B, L), bool), jax.random.key(0)
    observe = jax.jit(rssm.observe, static_argnums=0)
    one, _, _ = observe(dynamics, params, embeddings, actions, first, key)
    two, _, _ = observe(dynamics, params, embeddings.at[:, 0].add(1), actions, first, key)
    assert not jnp.allclose(one.features[:, -1], two.features[:, -1])


def test_observing_equals_its_steps_taken_one_by_one(model):
    dynamics, params = model
    variables, key = {"params": params}, jax.random.key(0)
    embeddings, actions = draws(B, L, E), draws(B, L, A)
    first = jnp.asarray(random.random((B, L)) < 0.3)
    observe = jax.jit(rssm.observe, static_argnums=0)
    states, prior_mean, prior_std = observe(dynamics, params, embeddings, actions, first, key)
    noise = jax.random.normal(key, (L, B, 4))
    state = dynamics.initial((B,))
    for t in range(L):
        keep = ~first[:, t, None]
        before = jax.tree.map(lambda x, keep=keep: jnp.where(keep, x, 0.0), state)
        action = jnp.where(keep, actions[:, t], 0.0)
        prior = dynamics.apply(variables, before, action, 0.0, method="img_step")
        projected = dynamics.apply(variables, embeddings[:, t], method="project")
        state = dynamics.apply(
            variables, state, actions[:, t], projected, first[:, t], noise[t], method="obs_step"
        )
        assert_allclose(states.features[:, t], state.features, atol=1e-5)
        assert_allclose(prior_mean[:, t], prior.mean, atol=1e-5)
        assert_allclose(prior_std[:, t], prior.std, atol=1e-5)


def test_imagination_excludes_the_start_and_feeds_the_policy_the_state_before(model):
    dynamics, params = model
    start = state_of(B)
    seen = []

    def policy(features, noise):
        return features[..., :A] + noise

    states = rssm.imagine(
        dynamics, params, policy, start, 3, jax.random.key(0), jnp.zeros((3, B, A))
    )
    assert states.deterministic.shape == (3, B, 8)
    noise = jax.random.normal(jax.random.key(0), (3, B, 4))
    state = start
    for t in range(3):
        action = state.features[..., :A]
        state = dynamics.apply({"params": params}, state, action, noise[t], method="img_step")
        seen.append(state.features)
    assert_allclose(states.features, jnp.stack(seen), atol=1e-5)


@pytest.mark.parametrize("shape", [(100, 300), (200, 600), (30, 12), (16, 16)])
def test_orthogonal_matrices_are_orthonormal_in_float32(shape):
    matrix = np.asarray(rssm.orthogonal(jax.random.key(0), shape), np.float64)
    product = matrix @ matrix.T if shape[0] <= shape[1] else matrix.T @ matrix
    assert_allclose(product, np.eye(min(shape)), atol=2e-6)


def test_orthogonal_matrices_have_no_preferred_sign():
    matrices = jax.jit(jax.vmap(lambda key: rssm.orthogonal(key, (4, 12))))(
        jax.random.split(jax.random.key(0), 2000)
    )
    assert_allclose(matrices.mean(0), 0.0, atol=5 * (1 / 12) ** 0.5 / 2000**0.5)
