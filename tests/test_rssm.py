"""The recurrent state-space model against independent formulas."""

import functools
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
    return random.normal(size=shape).astype(np.float32)


@functools.cache
def applied(method):
    """A method of the dynamics as a program of (dynamics, params, inputs)."""

    def call(dynamics, params, *inputs):
        return dynamics.apply({"params": params}, *inputs, method=method)

    return jax.jit(call, static_argnums=0)


@pytest.fixture(scope="module")
def model():
    dynamics = rssm.Dynamics(**SIZES, action_size=A, embedding_size=E)
    inputs = jnp.zeros((1, E)), jnp.zeros((1, A))
    params = jax.jit(dynamics.init)(jax.random.key(0), *inputs)["params"]
    # Biases are drawn at zero; a test of formulas must see them.
    leaves, treedef = jax.tree.flatten(params)
    return dynamics, jax.tree.unflatten(
        treedef, [np.asarray(x) + 0.1 * draws(*x.shape) for x in leaves]
    )


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
    mean, std = draws(*shape, 4), np.exp(draws(*shape, 4))
    return rssm.LatentState(mean, std, draws(*shape, 4), draws(*shape, 8))


def joined(state):
    """The features of a state."""
    return np.concatenate([state.stochastic, state.deterministic], axis=-1)


def test_the_gru_equals_one_written_in_numpy():
    gru = rssm.GRU(8)
    x, h = draws(B, 5), draws(B, 8)
    shapes = jax.eval_shape(gru.init, jax.random.key(1), x, h)["params"]
    params = {name: draws(*leaf.shape) for name, leaf in shapes.items()}
    assert_allclose(
        jax.jit(gru.apply)({"params": params}, x, h), numpy_gru(params, x, h), atol=1e-6
    )


def test_split_kernels_equal_one_dense_layer_on_the_concatenation(model):
    dynamics, params = model
    state, action, noise = state_of(B), draws(B, A), draws(B, 4)
    new = applied("img_step")(dynamics, params, state, action, noise)

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
        largest = np.abs(params["params"][name]["kernel"]).max()
        assert 0.98 * limit < largest <= limit


def test_the_posterior_equals_a_dense_layer_on_state_and_embedding(model):
    dynamics, params = model
    state, action, embedding = state_of(B), draws(B, A), draws(B, E)
    projected = applied("project")(dynamics, params, embedding)
    first, noise = np.zeros(B, bool), np.zeros((B, 4), np.float32)
    new = applied("obs_step")(dynamics, params, state, action, projected, first, noise)
    posterior = jax.tree.map(np.asarray, params["posterior"])
    joined = np.concatenate([new.deterministic, embedding], axis=-1)
    hidden = elu(joined @ posterior["hidden"]["kernel"] + posterior["hidden"]["bias"])
    expected = hidden @ posterior["out"]["kernel"] + posterior["out"]["bias"]
    assert_allclose(new.mean, expected[:, :4], atol=1e-5)


@functools.partial(jax.jit, static_argnums=0)
def observe(dynamics, params, *records):
    states, *prior = rssm.observe(dynamics, params, *records, jax.random.key(0))
    return states.features, *prior


def observed(*arguments):
    """The features, and the prior's means and standard deviations."""
    return map(np.asarray, observe(*arguments))


def test_a_first_record_makes_the_model_forget_all_before_it(model):
    dynamics, params = model
    embeddings, actions = draws(B, L, E), draws(B, L, A)
    first = np.zeros((B, L), bool)
    first[:, 3] = True

    other_embeddings, other_actions = embeddings.copy(), actions.copy()
    other_embeddings[:, :3] += 1
    other_actions[:, :3] += 1
    other_actions[:, 3] += 5
    original, *_ = observed(dynamics, params, embeddings, actions, first)
    changed, *_ = observed(dynamics, params, other_embeddings, other_actions, first)
    assert_array_equal(changed[:, 3:], original[:, 3:])
    assert not np.allclose(changed[:, :3], original[:, :3])


def test_without_a_first_record_the_model_remembers(model):
    dynamics, params = model
    embeddings, actions = draws(B, L, E), draws(B, L, A)
    first = np.zeros((B, L), bool)
    one, *_ = observed(dynamics, params, embeddings, actions, first)
    embeddings[:, 0] += 1
    two, *_ = observed(dynamics, params, embeddings, actions, first)
    assert not np.allclose(one[:, -1], two[:, -1])


def test_observing_equals_its_steps_taken_one_by_one(model):
    dynamics, params = model
    img_step, obs_step, project = map(applied, ("img_step", "obs_step", "project"))
    embeddings, actions = draws(B, L, E), draws(B, L, A)
    first = random.random((B, L)) < 0.3
    features, prior_mean, prior_std = observed(dynamics, params, embeddings, actions, first)
    noise = np.asarray(jax.random.normal(jax.random.key(0), (L, B, 4)))
    state = jax.tree.map(np.asarray, dynamics.initial((B,)))
    for t in range(L):
        keep = ~first[:, t, None]
        before = jax.tree.map(lambda x, keep=keep: np.where(keep, x, np.float32(0)), state)
        action = np.where(keep, actions[:, t], np.float32(0))
        prior = img_step(dynamics, params, before, action, 0 * noise[t])
        projected = project(dynamics, params, embeddings[:, t])
        state = obs_step(dynamics, params, state, actions[:, t], projected, first[:, t], noise[t])
        assert_allclose(features[:, t], joined(state), atol=1e-5)
        state = jax.tree.map(np.asarray, state)
        assert_allclose(prior_mean[:, t], prior.mean, atol=1e-5)
        assert_allclose(prior_std[:, t], prior.std, atol=1e-5)


def test_imagination_excludes_the_start_and_feeds_the_policy_the_state_before(model):
    dynamics, params = model
    start = state_of(B)
    seen = []

    def policy(features, noise):
        return features[..., :A] + noise

    @jax.jit
    def imagined(params, start):
        noise = jnp.zeros((3, B, A))
        states = rssm.imagine(dynamics, params, policy, start, 3, jax.random.key(0), noise)
        return states, states.features

    states, features = imagined(params, start)
    assert states.deterministic.shape == (3, B, 8)
    noise = np.asarray(jax.random.normal(jax.random.key(0), (3, B, 4)))
    state = start
    for t in range(3):
        action = joined(state)[..., :A]
        state = applied("img_step")(dynamics, params, state, action, noise[t])
        seen.append(joined(state))
    assert_allclose(features, np.stack(seen), atol=1e-5)


@pytest.mark.parametrize("shape", [(100, 300), (200, 600), (30, 12), (16, 16)])
def test_orthogonal_matrices_are_orthonormal_in_float32(shape):
    matrix = np.asarray(rssm.orthogonal(jax.random.key(0), shape), np.float64)
    product = matrix @ matrix.T if shape[0] <= shape[1] else matrix.T @ matrix
    assert_allclose(product, np.eye(min(shape)), atol=2e-6)


def test_orthogonal_matrices_have_no_preferred_sign():
    matrices = jax.jit(jax.vmap(lambda key: rssm.orthogonal(key, (4, 12))))(
        jax.random.split(jax.random.key(0), 2000)
    )
    assert_allclose(np.asarray(matrices).mean(0), 0.0, atol=5 * (1 / 12) ** 0.5 / 2000**0.5)
