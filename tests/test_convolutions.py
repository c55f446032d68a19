"""The two ways of computing the strided layers, against each other, flax and numbers by hand."""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from dreamer_jax.agent import Agent
from dreamer_jax.config import preset
from dreamer_jax.convolutions import (
    arrange,
    convolution,
    default_method,
    image_distance,
    normalise_image,
    transposed_convolution,
)

METHODS = ("library", "matmul")
LAYERS = (convolution, transposed_convolution)

# side of the input, side of the kernel, input and output channels
ENCODER_64 = [(64, 4, 3, 32), (31, 4, 32, 64), (14, 4, 64, 128), (6, 4, 128, 256)]
DECODER_64 = [(1, 5, 1024, 128), (5, 5, 128, 64), (13, 6, 64, 32), (30, 6, 32, 3)]
ENCODER_32 = [(32, 4, 3, 16), (15, 4, 16, 32), (6, 4, 32, 64)]
DECODER_32 = [(1, 5, 512, 32), (5, 6, 32, 16), (14, 6, 16, 3)]
REAL_LAYERS = [
    *((convolution, *sizes) for sizes in ENCODER_64 + ENCODER_32),
    *((transposed_convolution, *sizes) for sizes in DECODER_64 + DECODER_32),
]


def draw(batch, height, width, k, inputs, outputs, seed=0):
    """Draw x, kernel and bias such that the outputs are of the order of 1."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(*batch, height, width, inputs))
    kernel = rng.normal(size=(k, k, inputs, outputs)) / (k * inputs**0.5)
    bias = rng.normal(size=outputs)
    return tuple(np.asarray(each, np.float32) for each in (x, kernel, bias))


@functools.partial(jax.jit, static_argnums=(0, 1, 5))
def value_and_gradients(layer, method, x, kernel, bias, relu=False):
    """The output, and the gradients of a loss that weighs every entry of it differently."""

    def loss(x, kernel, bias):
        out = layer(x, kernel, bias, relu=relu, method=method)
        weights = np.cos(np.arange(out.size, dtype=np.float32)).reshape(out.shape)
        return jnp.sum(weights * jnp.square(out)), out

    gradients, out = jax.grad(loss, argnums=(0, 1, 2), has_aux=True)(x, kernel, bias)
    return {"out": out, **dict(zip(("x", "kernel", "bias"), gradients, strict=True))}


@functools.partial(jax.jit, static_argnums=(0, 1))
def both_methods(layer, relu, x, kernel, bias):
    """What the two ways of computing a layer give, in one program."""
    return tuple(value_and_gradients(layer, method, x, kernel, bias, relu) for method in METHODS)


@functools.cache
def jitted(layer):
    return jax.jit(layer, static_argnames=("relu", "method"))


def assert_same(actual, desired, tolerance=1e-5):
    """Compare relative to the largest entry, since sums may cancel."""
    assert actual.keys() == desired.keys()
    actual, desired = (jax.tree.map(np.asarray, each) for each in (actual, desired))
    for name in desired:
        scale = np.abs(desired[name]).max()
        assert_allclose(actual[name], desired[name], atol=tolerance * scale, rtol=0, err_msg=name)


@pytest.mark.parametrize(
    ("layer", "side", "k", "inputs", "outputs"),
    REAL_LAYERS,
    ids=[f"{layer.__name__}-{side}-{inputs}" for layer, side, _, inputs, _ in REAL_LAYERS],
)
def test_both_methods_agree_at_the_sizes_of_the_networks(layer, side, k, inputs, outputs):
    arguments = draw((2,), side, side, k, inputs, outputs)
    library, matmul = both_methods(layer, False, *arguments)
    assert_same(matmul, library)


@settings(max_examples=12, deadline=None, derandomize=True)
@given(
    transposed=st.booleans(),
    k=st.integers(2, 7),
    excess=st.tuples(st.integers(0, 6), st.integers(0, 6)),
    batch=st.lists(st.integers(1, 3), max_size=2),
    inputs=st.integers(1, 6),
    outputs=st.integers(1, 6),
    relu=st.booleans(),
)
def test_both_methods_agree_at_any_size(transposed, k, excess, batch, inputs, outputs, relu):
    layer = transposed_convolution if transposed else convolution
    smallest = 1 if transposed else k
    height, width = (smallest + each for each in excess)
    arguments = draw(batch, height, width, k, inputs, outputs)
    library, matmul = both_methods(layer, relu, *arguments)
    assert_same(matmul, library)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("layer", LAYERS)
def test_a_layer_with_relu_is_the_layer_and_then_relu(layer, method):
    arguments = draw((2,), 6, 7, 4, 3, 5)

    def relu_after(*arguments, relu, method):
        return jax.nn.relu(layer(*arguments, method=method))

    desired = value_and_gradients(relu_after, method, *arguments)
    assert 0.2 < np.mean(desired["out"] == 0) < 0.8
    assert_same(value_and_gradients(layer, method, *arguments, True), desired)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("batch", [(), (2,), (2, 3)], ids=str)
def test_both_layers_are_those_of_flax(method, batch):
    x, kernel, bias = draw(batch, 7, 9, 4, 3, 5)
    for layer, module in (
        (convolution, nn.Conv(5, (4, 4), strides=2, padding="VALID")),
        (transposed_convolution, nn.ConvTranspose(5, (4, 4), strides=(2, 2), padding="VALID")),
    ):

        @jax.jit
        def both(x, kernel, bias, layer=layer, module=module):
            params = {"kernel": kernel, "bias": bias}
            return layer(x, kernel, bias, method=method), module.apply({"params": params}, x)

        actual, desired = both(x, kernel, bias)
        assert actual.shape == desired.shape
        assert_allclose(actual, desired, atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_a_convolution_by_hand(method):
    x = np.arange(1, 17, dtype=np.float32).reshape(4, 4, 1)
    kernel = np.float32([[1, 2], [3, 4]]).reshape(2, 2, 1, 1)
    out = np.asarray(jitted(convolution)(x, kernel, np.float32([0.5]), method=method))
    assert_array_equal(out[..., 0], [[44.5, 64.5], [124.5, 144.5]])


@pytest.mark.parametrize("method", METHODS)
def test_a_transposed_convolution_by_hand(method):
    x = np.float32([1, 10]).reshape(2, 1, 1)
    kernel = np.arange(1, 10, dtype=np.float32).reshape(3, 3, 1, 1)
    layer = jitted(transposed_convolution)
    out = np.asarray(layer(x, kernel, np.float32([0.5]), method=method))
    desired = np.array([[9, 8, 7], [6, 5, 4], [93, 82, 71], [60, 50, 40], [30, 20, 10]])
    assert_array_equal(out[..., 0], desired + 0.5)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("layer", LAYERS)
def test_a_population_may_have_a_kernel_for_each_member(layer, method):
    members = [draw((2,), 6, 5, 4, 3, 4, seed) for seed in range(3)]
    stacked = [np.stack(leaves) for leaves in zip(*members, strict=True)]

    def evaluate(x, kernel, bias):
        return value_and_gradients(layer, method, x, kernel, bias)

    population = jax.tree.map(np.asarray, jax.jit(jax.vmap(evaluate))(*stacked))
    for index, member in enumerate(members):
        assert_same({k: v[index] for k, v in population.items()}, evaluate(*member))


@pytest.mark.parametrize("layer", LAYERS)
def test_members_may_share_images_but_not_kernels(layer):
    x, kernel, bias = draw((2,), 6, 5, 4, 3, 4)
    kernels = np.stack([kernel, 2 * kernel])
    mapped = jax.jit(jax.vmap(lambda kernel: layer(x, kernel, bias, method="matmul")))
    outs = np.asarray(mapped(kernels))
    assert_allclose(outs[1] - bias, 2 * (outs[0] - bias), atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("layer", LAYERS)
def test_bfloat16_inputs_give_bfloat16_outputs_and_gradients_summed_in_float32(layer, method):
    # Every output is a sum of C = 1024 ones or more, and bfloat16 cannot count past 256.
    x = np.ones((2, 2, 1024), jnp.bfloat16)
    kernel, bias = np.ones((2, 2, 1024, 1), np.float32), np.zeros(1, np.float32)
    out = np.asarray(jitted(layer)(x, kernel, bias, method=method))
    assert out.dtype == jnp.bfloat16
    assert_array_equal(out, 4096 if layer is convolution else 1024)

    arguments = draw((4,), 9, 9, 4, 5, 6)
    low = value_and_gradients(layer, method, arguments[0].astype(jnp.bfloat16), *arguments[1:])
    assert low["x"].dtype == jnp.bfloat16
    assert low["kernel"].dtype == low["bias"].dtype == jnp.float32
    low = {name: np.asarray(leaf, np.float32) for name, leaf in low.items()}
    assert_same(low, value_and_gradients(layer, method, *arguments), tolerance=0.03)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("layer", LAYERS)
def test_an_empty_batch_gives_an_empty_batch(layer, method):
    x, kernel, bias = draw((2, 0), 6, 6, 4, 3, 5)
    side = 2 if layer is convolution else 14
    out = jitted(layer)(x, kernel, bias, method=method)
    assert out.shape == (2, 0, side, side, 5)


def test_the_gradient_of_images_is_not_computed_unless_asked_for():
    x, kernel, bias = draw((2,), 8, 8, 4, 3, 5)

    def products(argnums):
        gradient = jax.grad(
            lambda *a: jnp.square(convolution(*a, method="matmul")).sum(), argnums=argnums
        )
        text = jax.jit(gradient).lower(x, kernel, bias).compile().as_text()
        return text.count(" dot(")

    assert products(argnums=1) == 2  # the layer itself and the gradient of its kernel
    assert products(argnums=(0, 1)) == 3


def test_the_default_is_matmul_on_cpus_and_nvidia_cards_and_the_library_elsewhere(monkeypatch):
    for backend in "cpu", "gpu":
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        assert default_method() == "matmul"
    monkeypatch.setattr(jax, "default_backend", lambda: "tpu")
    assert default_method() == "library"

    x, kernel, bias = draw((), 6, 6, 4, 3, 5)

    def uses_library():
        # A fresh function, since JAX remembers what it traced.
        return "conv_general_dilated" in str(
            jax.make_jaxpr(lambda *a: convolution(*a))(x, kernel, bias)
        )

    assert uses_library()
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    assert not uses_library()


@pytest.mark.parametrize(("method", "layers"), [("matmul", 0), ("library", 6), ("auto", 0)])
def test_the_setting_of_a_network_chooses_the_method(method, layers):
    config = preset("debug")
    network = dataclasses.replace(config.network, convolutions=method)
    agent = Agent(dataclasses.replace(config, network=network), 2)

    def seen_and_drawn(params, images):
        return agent.decode(params, jnp.zeros((1, network.feature_size))), agent.encode(
            params, images
        )

    images = jax.ShapeDtypeStruct((1, 32, 32, 3), jnp.uint8)
    text = str(jax.make_jaxpr(seen_and_drawn)(agent.parameter_shapes(), images))
    assert text.count("conv_general_dilated") == layers


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x": (6, 6)}, r"x of shape \(6, 6\), expected \[\.\.\., height, width, channels\]"),
        ({"x": (6, 6, 2)}, r"x with 2 channels, expected the 3 input channels"),
        ({"kernel": (4, 5, 3, 5)}, r"kernel of shape \(4, 5, 3, 5\), expected a square one"),
        ({"kernel": (4, 3, 5)}, r"kernel of shape \(4, 3, 5\), expected a square one"),
        ({"bias": (4,)}, r"bias of shape \(4,\), expected \(5,\)"),
    ],
    ids=str,
)
def test_shapes_that_do_not_fit_are_named(layer, changes, message):
    shapes = {"x": (6, 6, 3), "kernel": (4, 4, 3, 5), "bias": (5,)} | changes
    with pytest.raises(ValueError, match=f"^{layer.__name__}: got .*{message}"):
        layer(**{name: jnp.zeros(shape) for name, shape in shapes.items()})


@pytest.mark.parametrize("layer", LAYERS)
def test_images_of_bytes_are_refused_with_the_way_to_convert_them(layer):
    x = jnp.zeros((6, 6, 3), jnp.uint8)
    with pytest.raises(ValueError, match=r"x of type uint8, .* x\.astype\(jnp\.float32\) / 255"):
        layer(x, jnp.zeros((4, 4, 3, 5)), jnp.zeros(5))


@pytest.mark.parametrize("layer", LAYERS)
def test_an_unknown_method_is_refused_with_the_choices(layer):
    with pytest.raises(ValueError, match="got method 'fast', expected 'library', 'matmul' or None"):
        layer(*draw((), 6, 6, 4, 3, 5), method="fast")


def test_an_image_smaller_than_the_kernel_is_refused():
    with pytest.raises(ValueError, match="image of 3 x 6, expected at least 4 x 4"):
        convolution(*draw((), 3, 6, 4, 3, 5))


def test_a_transposed_convolution_of_kernel_1_is_refused():
    with pytest.raises(ValueError, match="kernel of 1 x 1, expected 2 x 2 or more"):
        transposed_convolution(*draw((), 3, 3, 1, 3, 5))


def some_images(*batch):
    return np.random.default_rng(0).integers(0, 256, (*batch, 8, 6, 3), dtype=np.uint8)


@pytest.mark.parametrize("method", METHODS)
def test_arranged_images_are_the_same_images(method):
    images = some_images(2, 3)
    assert_array_equal(arrange(images, method=method), images)


@pytest.mark.parametrize("method", METHODS)
def test_the_distance_of_images_is_half_the_sum_of_squares_and_so_is_its_gradient(method):
    images = some_images(2, 3)
    prediction = np.random.default_rng(1).normal(size=images.shape).astype(np.float32)
    weights = np.arange(1.0, 7.0, dtype=np.float32).reshape(2, 3)

    def loss(prediction):
        distance = image_distance(prediction, arrange(images, method=method), method=method)
        return (weights * distance).sum(), distance

    gradient, distance = jax.jit(jax.grad(loss, has_aux=True))(prediction)
    error = prediction - (images / 255.0 - 0.5)
    assert_allclose(distance, 0.5 * (error**2).sum((2, 3, 4)), rtol=1e-5)
    assert_allclose(gradient, weights[..., None, None, None] * error, rtol=1e-5, atol=1e-5)


def test_normalised_images_lie_between_minus_and_plus_one_half():
    assert_allclose(normalise_image(np.array([0, 255], np.uint8)), [-0.5, 0.5])
