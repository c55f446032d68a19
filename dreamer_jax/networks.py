"""Encoder, decoder, dense heads and the action distribution (thesis section 3.1, figure 7).

Axis letters: A action, M latent feature size, E embedding size. Leading axes (batch, time) are
free and written "...".

Kernels are drawn as Keras draws them, because fractional transfer adds source weights to fresh
ones: Glorot-uniform kernels and zero biases. Parameters are float32; activations have the
module's dtype. What a head or a distribution is read from is float32 from its last product on:
bfloat16 has 8 bits, and tells numbers about 150 apart by whole ones alone.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from dreamer_jax.convolutions import Method, convolution, transposed_convolution

Dtype = jnp.dtype | type

# Flax asks an initialiser for its shape whenever a parameter is read: it is traced once.
glorot_uniform = jax.jit(nn.initializers.glorot_uniform(), static_argnums=1)
zeros = jax.jit(nn.initializers.zeros, static_argnums=1)


@functools.partial(jax.jit, static_argnums=(1, 2))
def uniform(key: jax.Array, shape: tuple[int, ...], limit: float) -> jax.Array:
    """float32 numbers between -limit and limit."""
    return jax.random.uniform(key, shape, jnp.float32, -limit, limit)


def add_bias(outputs: jax.Array, bias: jax.Array) -> jax.Array:
    """A layer's outputs [..., O] plus its float32 bias [O], in the dtype of the outputs.

    Added in float32, so that the gradient of the bias, a sum over the batch, is summed in it.
    """
    return (outputs + bias).astype(outputs.dtype)


class Dense(nn.Module):
    """A dense layer drawn as Keras draws it.

    Attributes:
      features: number of outputs.
      use_bias: whether to add a bias.
      fan_in: number of inputs that the kernel's range is computed for, where the kernel is one
        part of a larger one; none given: the number of inputs.
      dtype: dtype of the computation.
      output_dtype: dtype that the sums of the product have and the bias is added in; none given:
        `dtype`, the bias being added in float32.
    """

    features: int
    use_bias: bool = True
    fan_in: int | None = None
    dtype: Dtype = jnp.float32
    output_dtype: Dtype | None = None

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        fan_in = self.fan_in or inputs.shape[-1]
        limit = math.sqrt(6 / (fan_in + self.features))
        kernel = self.param("kernel", uniform, (inputs.shape[-1], self.features), limit)
        outputs = jnp.matmul(
            inputs.astype(self.dtype),
            kernel.astype(self.dtype),
            preferred_element_type=self.output_dtype,
        )
        if self.use_bias:
            bias = self.param("bias", zeros, (self.features,))
            outputs = add_bias(outputs, bias)
        return outputs


class Convolution(nn.Module):
    """A convolution, or a transposed one, of stride 2 without padding, and a relu.

    The same two parameters serve every method of computing it (see dreamer_jax.convolutions).
    """

    features: int
    kernel_size: int
    transposed: bool = False
    relu: bool = True
    dtype: Dtype = jnp.float32
    method: Method | None = None

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        shape = (self.kernel_size, self.kernel_size, inputs.shape[-1], self.features)
        kernel = self.param("kernel", glorot_uniform, shape)
        bias = self.param("bias", zeros, (self.features,))
        apply = transposed_convolution if self.transposed else convolution
        arrays = (x.astype(self.dtype) for x in (inputs, kernel, bias))
        return apply(*arrays, relu=self.relu, method=self.method)


def encoder_layers(image_size: int) -> int:
    """Convolutions of the encoder: 4 for 64 pixels (to 2 x 2), 3 for 32 (to 2 x 2)."""
    return {64: 4, 32: 3}[image_size]


class Encoder(nn.Module):
    """Images to embeddings: convolutions of kernel 4 and stride 2, relu.

    float [..., size, size, 3] in [-0.5, 0.5] -> [..., E]; E is 1024 at thesis sizes.
    """

    depth: int
    image_size: int
    dtype: Dtype = jnp.float32
    method: Method | None = None

    @nn.compact
    def __call__(self, images: jax.Array) -> jax.Array:
        x = images
        for i in range(encoder_layers(self.image_size)):
            x = Convolution(
                self.depth * 2**i, 4, dtype=self.dtype, method=self.method, name=f"conv_{i}"
            )(x)
        return x.reshape(*x.shape[:-3], -1)


class Decoder(nn.Module):
    """Features to the mean of the image: one linear dense layer, then transposed convolutions.

    float [..., M] -> float32 [..., size, size, 3]. Kernels 5, 5, 6, 6 for 64 pixels
    (1 -> 5 -> 13 -> 30 -> 64) and 5, 6, 6 for 32 (1 -> 5 -> 14 -> 32).
    """

    depth: int
    image_size: int
    dtype: Dtype = jnp.float32
    method: Method | None = None

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        kernels = {64: (5, 5, 6, 6), 32: (5, 6, 6)}[self.image_size]
        layers = len(kernels)
        x = Dense(self.depth * 2 ** (layers + 1), dtype=self.dtype, name="dense")(features)
        x = x.reshape(*x.shape[:-1], 1, 1, x.shape[-1])
        for i, kernel in enumerate(kernels):
            last = i == layers - 1
            channels = 3 if last else self.depth * 2 ** (layers - 2 - i)
            x = Convolution(
                channels,
                kernel,
                transposed=True,
                relu=not last,
                dtype=self.dtype,
                method=self.method,
                name=f"deconv_{i}",
            )(x)
        return x.astype(jnp.float32)


def elu(x: jax.Array) -> jax.Array:
    """x where it is positive, exp(x) - 1 elsewhere.

    `jax.nn.elu` is more exact about 0 by expm1, which takes several times as long on a CPU; here
    the error is that of rounding at 1, in float32 whatever the dtype of x.
    """
    exponential = jnp.exp(jnp.where(x > 0, 0.0, x).astype(jnp.float32))
    return jnp.where(x > 0, x, (exponential - 1).astype(x.dtype))


class Head(nn.Module):
    """Hidden layers of elu units and a linear output: [..., M] -> float32 [..., outputs]."""

    outputs: int
    layers: int
    units: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        x = features
        for i in range(self.layers):
            x = elu(Dense(self.units, dtype=self.dtype, name=f"hidden_{i}")(x))
        return Dense(self.outputs, dtype=self.dtype, output_dtype=jnp.float32, name="out")(x)


MEAN_SCALE = 5.0
INITIAL_STD = 5.0
MINIMUM_ACTION_STD = 1e-4
MODE_SAMPLES = 100


def tanh_normal(outputs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and standard deviation, before the tanh, from the actor's outputs.

    Args:
      outputs: float32 [..., 2 A].

    Returns:
      mean 5 tanh(x / 5) and std softplus(x + softplus⁻¹(5)) + 1e-4, each [..., A].
    """
    mean, std = jnp.split(outputs, 2, axis=-1)
    mean = MEAN_SCALE * jnp.tanh(mean / MEAN_SCALE)
    shift = math.log(math.expm1(INITIAL_STD))
    return mean, jax.nn.softplus(std + shift) + MINIMUM_ACTION_STD


def tanh_normal_sample(outputs: jax.Array, noise: jax.Array) -> jax.Array:
    """Reparameterised sample in (-1, 1): tanh(mean + std * noise), [..., A]."""
    mean, std = tanh_normal(outputs)
    return jnp.tanh(mean + std * noise)


def tanh_normal_log_probability(outputs: jax.Array, pre_tanh: jax.Array) -> jax.Array:
    """Log-density of the action tanh(pre_tanh), summed over A.

    log N(x; mean, std) - Σ log(1 - tanh²(x)), the last in the stable form
    2 (log 2 - x - softplus(-2x)).

    Args:
      outputs: float32 [..., 2 A], the actor's outputs.
      pre_tanh: float32 [..., A], the value x before the tanh.

    Returns:
      float32 [...].
    """
    mean, std = tanh_normal(outputs)
    standardised = (pre_tanh - mean) / std
    normal = -0.5 * standardised**2 - jnp.log(std) - 0.5 * math.log(2 * math.pi)
    volume = 2 * (math.log(2) - pre_tanh - jax.nn.softplus(-2 * pre_tanh))
    return (normal - volume).sum(-1)


def tanh_normal_mode(outputs: jax.Array, key: jax.Array) -> jax.Array:
    """The most likely of 100 samples, [..., A]: a tanh-normal has no mode in closed form."""
    mean, std = tanh_normal(outputs)
    noise = jax.random.normal(key, (MODE_SAMPLES, *mean.shape))
    candidates = mean + std * noise
    scores = tanh_normal_log_probability(outputs, candidates)
    best = jnp.argmax(scores, axis=0)
    chosen = jnp.take_along_axis(candidates, best[None, ..., None], axis=0)[0]
    return jnp.tanh(chosen)


def one_hot_sample(logits: jax.Array, noise: jax.Array) -> jax.Array:
    """One-hot sample with the straight-through gradient of the probabilities.

    Args:
      logits: float32 [..., A].
      noise: float32 [..., A] of standard Gumbel noise.

    Returns:
      float32 [..., A], exactly one-hot in value.
    """
    sample = jax.nn.one_hot(jnp.argmax(logits + noise, axis=-1), logits.shape[-1])
    probabilities = jax.nn.softmax(logits)
    # The difference is exactly zero in value, so the sample stays exactly one-hot.
    return sample + (probabilities - jax.lax.stop_gradient(probabilities))


def applied(module: nn.Module, params: Any, *inputs: Any, method: str | None = None) -> Any:
    """What a module makes of its inputs with given parameters, by a method of it other than its
    call if one is named."""
    return module.apply({"params": params}, *inputs, method=method)


def parameter_count(params) -> int:
    """Number of scalars in a tree of parameters."""
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(params))
