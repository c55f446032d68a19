"""Networks at thesis sizes, and the action distribution."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dreamer_jax import networks
from dreamer_jax.agent import Agent
from dreamer_jax.config import preset


@pytest.fixture(scope="module")
def thesis():
    agent = Agent(preset("thesis"), action_size=6)
    return agent, jax.eval_shape(agent.init_params, jax.random.key(0))


def test_parameter_counts_at_thesis_sizes_are_those_worked_out_by_hand(thesis):
    _, params = thesis
    counts = {name: networks.parameter_count(part) for name, part in params.items()}
    channels = [3, 32, 64, 128, 256]
    encoder = sum(16 * a * b + b for a, b in zip(channels, channels[1:], strict=False))
    layers = [(25, 1024, 128), (25, 128, 64), (36, 64, 32), (36, 32, 3)]
    decoder = 230 * 1024 + 1024 + sum(area * a * b + b for area, a, b in layers)
    gaussian = 200 * 60 + 60
    dynamics = (
        (30 * 200 + 200)  # stoch_in
        + 6 * 200  # action_in
        + (200 * 600 + 200 * 600 + 2 * 600)  # gru
        + (200 * 200 + 200 + gaussian)  # prior
        + ((200 + 1024) * 200 + 200 + gaussian)  # posterior
    )

    def head(layers, outputs):
        hidden = 230 * 400 + 400 + (layers - 1) * (400 * 400 + 400)
        return hidden + 400 * outputs + outputs

    assert counts == {
        "encoder": encoder,
        "decoder": decoder,
        "dynamics": dynamics,
        "reward": head(2, 1),
        "value": head(3, 1),
        "actor": head(4, 12),
    }


def test_names_of_parameters_read_like_the_thesis(thesis):
    _, params = thesis
    assert set(params["dynamics"]) == {"stoch_in", "action_in", "gru", "prior", "posterior"}
    assert set(params["dynamics"]["action_in"]) == {"kernel"}
    assert set(params["reward"]) == {"hidden_0", "hidden_1", "out"}
    assert set(params["value"]) == {"hidden_0", "hidden_1", "hidden_2", "out"}
    assert set(params["actor"]) == {"hidden_0", "hidden_1", "hidden_2", "hidden_3", "out"}


@pytest.mark.parametrize(("size", "depth", "embedding"), [(64, 32, 1024), (32, 16, 256)])
def test_the_decoder_undoes_the_encoder_in_shape(size, depth, embedding):
    encoder, decoder = networks.Encoder(depth, size), networks.Decoder(depth, size)

    def both(key):
        images = jnp.zeros((2, 5, size, size, 3))
        code, _ = encoder.init_with_output(key, images)
        return code, decoder.init_with_output(key, jnp.zeros((2, 5, 230)))[0]

    code, images = jax.eval_shape(both, jax.random.key(0))
    assert code.shape == (2, 5, embedding)
    assert images.shape == (2, 5, size, size, 3)


def test_kernels_lie_in_the_range_of_glorot_and_fill_it():
    init = jax.jit(networks.Dense(200).init)
    kernel = np.asarray(init(jax.random.key(0), np.zeros((1, 100)))["params"]["kernel"])
    limit = math.sqrt(6 / 300)
    assert 0.98 * limit < np.abs(kernel).max() <= limit
    assert_allclose(kernel.std(), limit / math.sqrt(3), rtol=0.02)


def test_elu_is_that_of_jax_and_so_is_its_gradient():
    x = np.float32([-100.0, -3.0, -1e-3, 0.0, 1e-3, 2.0, 100.0])
    (value, gradient), (expected, expected_gradient) = (
        jax.jit(jax.vmap(jax.value_and_grad(f)))(x) for f in (networks.elu, jax.nn.elu)
    )
    assert_allclose(value, expected, atol=1e-7)
    assert_allclose(gradient, expected_gradient, rtol=1e-6)


def test_the_action_distribution_is_that_of_dreamer():
    mean, std = jax.jit(networks.tanh_normal)(np.float32([[0.0, 100.0, 0.0, -2.0]]))
    assert_allclose(mean, [[0.0, 5.0]], rtol=1e-6)
    shift = math.log(math.exp(5) - 1)
    expected = [[5 + 1e-4, math.log1p(math.exp(shift - 2)) + 1e-4]]
    assert_allclose(std, expected, rtol=1e-5)


log_probability = jax.jit(networks.tanh_normal_log_probability)


def test_the_log_density_of_actions_integrates_to_one():
    outputs = np.float32([0.3, -5.2])
    actions = np.linspace(-1, 1, 20_001)[1:-1]
    log_density = log_probability(outputs, np.arctanh(actions)[:, None])
    assert_allclose(np.trapezoid(np.exp(log_density), actions), 1.0, atol=1e-3)


def test_the_log_density_of_actions_is_that_of_a_change_of_variables():
    outputs, x = np.float32([0.5, -0.2, 0.1, -1.0]), np.float32([0.7, -1.1])
    mean, std = map(np.asarray, jax.jit(networks.tanh_normal)(outputs))
    normal = -0.5 * ((x - mean) / std) ** 2 - np.log(std) - 0.5 * math.log(2 * math.pi)
    expected = (normal - np.log(1 - np.tanh(x) ** 2)).sum()
    assert_allclose(log_probability(outputs, x), expected, rtol=1e-5)


def test_the_mode_is_the_most_likely_of_its_samples():
    outputs, key = np.float32([0.4, -3.0]), jax.random.key(3)
    mean, std = map(np.asarray, jax.jit(networks.tanh_normal)(outputs))
    candidates = mean + std * np.asarray(jax.random.normal(key, (networks.MODE_SAMPLES, 1)))
    likeliest = np.argmax(log_probability(outputs, candidates))
    expected = np.tanh(candidates[likeliest])
    assert_allclose(jax.jit(networks.tanh_normal_mode)(outputs, key), expected, rtol=1e-6)
    assert len(np.unique(candidates)) == networks.MODE_SAMPLES


def test_one_hot_samples_are_exact_and_pass_the_gradient_of_probabilities():
    logits = np.float32([[0.1, 2.0, -1.0], [3.0, 0.0, 0.2]])
    noise = np.random.default_rng(0).gumbel(size=logits.shape).astype(np.float32)
    sample = np.asarray(jax.jit(networks.one_hot_sample)(logits, noise))
    assert set(np.unique(sample)) == {0.0, 1.0}
    assert_array_equal(sample.sum(-1), 1.0)
    direction = np.float32([1.0, -2.0, 0.5])

    @jax.jit
    @jax.grad
    def straight(x):
        return (networks.one_hot_sample(x, noise) * direction).sum()

    @jax.jit
    @jax.grad
    def smooth(x):
        return (jax.nn.softmax(x) * direction).sum()

    assert_allclose(straight(logits), smooth(logits), rtol=1e-5, atol=1e-7)


def test_one_hot_samples_have_the_probabilities_of_the_logits():
    logits = np.log(np.float32([0.7, 0.2, 0.1]))
    noise = np.random.default_rng(0).gumbel(size=(20_000, 3)).astype(np.float32)
    samples = np.asarray(jax.jit(networks.one_hot_sample)(logits, noise))
    assert_allclose(samples.mean(0), [0.7, 0.2, 0.1], atol=0.015)
