"""Operations counted in a trace, against counts by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from dreamer_jax.agent import Agent
from dreamer_jax.config import preset
from experiments.thesis import measurement
from experiments.thesis.flops import count


def shape(*sizes):
    return jax.ShapeDtypeStruct(sizes, jnp.float32)


def test_a_product_of_matrices_is_two_operations_for_each_of_its_products():
    assert count(jnp.matmul, shape(3, 4), shape(4, 5)) == 2 * 3 * 4 * 5
    batched = jax.vmap(jnp.matmul)
    assert count(batched, shape(7, 3, 4), shape(7, 4, 5)) == 7 * 2 * 3 * 4 * 5


def test_a_convolution_counts_its_kernel_for_each_output():
    def convolve(image, kernel):
        return jax.lax.conv_general_dilated(
            image, kernel, (2, 2), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )

    assert count(convolve, shape(2, 8, 8, 3), shape(4, 4, 3, 6)) == 2 * (2 * 3 * 3 * 6) * 4 * 4 * 3


def test_the_zeros_of_a_transposed_convolution_count_nothing():
    def convolve(image, kernel):
        return jax.lax.conv_transpose(image, kernel, (2, 2), "VALID")

    # Each of the 5 x 5 pixels meets each of the 6 x 6 weights, for each pair of channels.
    expected = 2 * (7 * 5 * 5) * (6 * 6) * (4 * 3)
    assert count(convolve, shape(7, 5, 5, 4), shape(6, 6, 4, 3)) == expected

    def gradients(image, kernel):
        return jax.grad(lambda *x: convolve(*x).sum(), argnums=(0, 1))(image, kernel)

    # The sum is one number for each of the 14 x 14 pixels, and so is its gradient; beside them the
    # result and two gradients, of as many products each.
    others = 2 * 7 * 14 * 14 * 3
    assert 3 * expected <= count(gradients, shape(7, 5, 5, 4), shape(6, 6, 4, 3))
    assert count(gradients, shape(7, 5, 5, 4), shape(6, 6, 4, 3)) < 3 * expected + 2 * others


def test_an_update_is_as_much_arithmetic_with_the_layers_of_the_library():
    config = preset("cpu")
    products, library = (
        measurement.operations(
            Agent(
                dataclasses.replace(
                    config, network=dataclasses.replace(config.network, convolutions=method)
                ),
                2,
            )
        )
        for method in ("matmul", "library")
    )
    assert products != library
    assert products == pytest.approx(library, rel=0.1)


def test_loops_count_every_turn_and_functions_what_is_in_them():
    def scanned(x, w):
        return jax.lax.scan(lambda carry, _: (carry @ w, None), x, length=10)[0]

    assert count(scanned, shape(3, 3), shape(3, 3)) == 10 * 2 * 27
    assert count(jax.jit(jax.checkpoint(scanned)), shape(3, 3), shape(3, 3)) == 540
    assert count(lambda x: jnp.tanh(x), shape(11)) == 11


def test_a_large_update_is_sampled_on_smaller_batches_of_the_same_networks(monkeypatch):
    config = preset("debug")
    learning = dataclasses.replace(config.learning, batch_size=8, sequence_length=20)
    agent = Agent(dataclasses.replace(config, learning=learning), 2)
    monkeypatch.setattr(measurement, "SAMPLE_OPERATIONS", 1.0)
    part, times = measurement.sample_of(agent)
    assert part.config.network == agent.config.network
    learning = part.config.learning
    assert (learning.batch_size, learning.sequence_length) == (2, 5)
    # 16 times the records; what an update does to parameters does not grow.
    assert 8 < times < 16
