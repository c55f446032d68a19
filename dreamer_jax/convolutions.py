"""Stride-2 convolutions and transposed convolutions, as library calls or as matrix products.

XLA's CPU backend is slow at strided and transposed convolutions, and slowest at their gradients;
the same sums arranged as matrix products take a fraction of the time. Accelerators have good
convolution kernels of their own. Both layers therefore have two ways to be computed and one
definition of their parameters, so that a tree trained on one kind of device runs on another.

Every window has stride 2 and no padding ("VALID"). In the shapes below k is the side of the
kernel, C the input channels, O the output channels, and "..." any number of batch axes.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from jax import lax

Method = Literal["library", "matmul"]

_DIMENSIONS = ("NHWC", "HWIO", "NHWC")


def default_method() -> Method:
    """Return the faster method on the default device: "matmul" on a CPU, "library" elsewhere."""
    return "matmul" if jax.default_backend() == "cpu" else "library"


def convolution(x, kernel, bias, *, method: Method | None = None):
    """Convolve with stride 2: an image of side n becomes one of side (n - k) // 2 + 1.

    The layer of `flax.linen.Conv(O, (k, k), strides=2, padding="VALID")`.

    Args:
      x: float [..., height, width, C]; its type is the type of the computation and of the result.
      kernel: [k, k, C, O], cast to the type of x.
      bias: [O], cast to the type of x.
      method: "library", "matmul", or None for `default_method()`.

    Returns:
      float [..., (height - k) // 2 + 1, (width - k) // 2 + 1, O]. Sums are accumulated in float32
      whatever the type of x.

    Raises:
      ValueError: the shapes do not fit one another, the kernel is larger than the image, x is not
        of a floating type, or the method is unknown.
    """
    method = _check("convolution", x, kernel, bias, method)
    k = kernel.shape[0]
    if min(x.shape[-3:-1]) < k:
        raise ValueError(
            f"convolution: got an image of {x.shape[-3]} x {x.shape[-2]}, expected at least "
            f"{k} x {k}, the size of the kernel; use larger images or fewer layers"
        )
    compute = _library_convolution if method == "library" else _matmul_convolution
    return _over_batch(compute, x, kernel, bias)


def transposed_convolution(x, kernel, bias, *, method: Method | None = None):
    """Convolve transposed with stride 2: an image of side n becomes one of side 2 (n - 1) + k.

    The layer of `flax.linen.ConvTranspose(O, (k, k), strides=2, padding="VALID")`: kernel row i of
    input row m adds to output row 2 m + k - 1 - i.

    Args:
      x: float [..., height, width, C]; its type is the type of the computation and of the result.
      kernel: [k, k, C, O], cast to the type of x; k is at least 2.
      bias: [O], cast to the type of x.
      method: "library", "matmul", or None for `default_method()`.

    Returns:
      float [..., 2 (height - 1) + k, 2 (width - 1) + k, O]. Sums are accumulated in float32
      whatever the type of x.

    Raises:
      ValueError: the shapes do not fit one another, x is not of a floating type, or the method is
        unknown.
    """
    method = _check("transposed_convolution", x, kernel, bias, method)
    if kernel.shape[0] < 2:
        raise ValueError(
            "transposed_convolution: got a kernel of 1 x 1, expected 2 x 2 or more, since the "
            "stride is 2; use a larger kernel"
        )
    if method == "library":
        compute = _library_transposed_convolution
    elif x.shape[-3:-1] == (1, 1):
        compute = _dense_transposed_convolution
    else:
        compute = _matmul_transposed_convolution
    return _over_batch(compute, x, kernel, bias)


def _check(name, x, kernel, bias, method):
    """Raise if the arguments do not fit one another; return the method to use."""
    if method is None:
        method = default_method()
    if method not in ("library", "matmul"):
        raise ValueError(f"{name}: got method {method!r}, expected 'library', 'matmul' or None")
    if not jnp.issubdtype(x.dtype, jnp.floating):
        raise ValueError(
            f"{name}: got x of type {x.dtype}, expected a floating type; convert images with "
            "x.astype(jnp.float32) / 255 - 0.5"
        )
    if x.ndim < 3:
        raise ValueError(
            f"{name}: got x of shape {x.shape}, expected [..., height, width, channels]"
        )
    if kernel.ndim != 4 or kernel.shape[0] != kernel.shape[1]:
        raise ValueError(
            f"{name}: got a kernel of shape {kernel.shape}, expected a square one of shape "
            "[k, k, input channels, output channels]"
        )
    if kernel.shape[2] != x.shape[-1]:
        raise ValueError(
            f"{name}: got x with {x.shape[-1]} channels, expected the {kernel.shape[2]} input "
            f"channels of the kernel, whose shape is {kernel.shape}"
        )
    if bias.shape != kernel.shape[3:]:
        raise ValueError(
            f"{name}: got a bias of shape {bias.shape}, expected {kernel.shape[3:]}, the output "
            f"channels of the kernel, whose shape is {kernel.shape}"
        )
    return method


def _over_batch(compute, x, kernel, bias):
    """Call `compute` with the batch axes of x as one, and all arguments of x's type."""
    batch = x.shape[:-3]
    out = compute(x.reshape(-1, *x.shape[-3:]), kernel.astype(x.dtype), bias.astype(x.dtype))
    return out.reshape(*batch, *out.shape[1:])


def _library_convolution(x, kernel, bias):
    return (
        lax.conv_general_dilated(x, kernel, (2, 2), "VALID", dimension_numbers=_DIMENSIONS) + bias
    )


def _library_transposed_convolution(x, kernel, bias):
    return lax.conv_transpose(x, kernel, (2, 2), "VALID", dimension_numbers=_DIMENSIONS) + bias


def _matmul_convolution(x, kernel, bias):
    """Fold 2 x 2 pixels into channels; what is left is a convolution of stride 1."""
    k, _, channels, outputs = kernel.shape
    taps = (k + 1) // 2
    height, width = ((side - k) // 2 + taps for side in x.shape[1:3])
    x = _fit(x, 2 * height, 2 * width)
    x = x.reshape(-1, height, 2, width, 2, channels).transpose(0, 1, 3, 2, 4, 5)
    x = x.reshape(-1, height, width, 4 * channels)
    kernel = _fit(kernel[None], 2 * taps, 2 * taps)
    kernel = kernel.reshape(taps, 2, taps, 2, channels, outputs).transpose(0, 2, 1, 3, 4, 5)
    return _stride_1(x, kernel.reshape(taps, taps, 4 * channels, outputs)) + bias


def _matmul_transposed_convolution(x, kernel, bias):
    """Make the 2 x 2 phases of the output as channels with stride 1, then unfold them."""
    k, _, channels, outputs = kernel.shape
    taps = (k + 1) // 2
    out_height, out_width = (2 * (side - 1) + k for side in x.shape[1:3])
    edge = taps - 1
    x = jnp.pad(x, ((0, 0), (edge, edge), (edge, edge), (0, 0)))
    kernel = kernel if k % 2 == 0 else jnp.pad(kernel, ((1, 0), (1, 0), (0, 0), (0, 0)))
    kernel = kernel.reshape(taps, 2, taps, 2, channels, outputs)[:, ::-1, :, ::-1]
    kernel = kernel.transpose(0, 2, 4, 1, 3, 5).reshape(taps, taps, channels, 4 * outputs)
    y = _stride_1(x, kernel)
    _, height, width, _ = y.shape
    y = y.reshape(-1, height, width, 2, 2, outputs).transpose(0, 1, 3, 2, 4, 5)
    y = y.reshape(-1, 2 * height, 2 * width, outputs)
    return y[:, :out_height, :out_width] + bias


def _dense_transposed_convolution(x, kernel, bias):
    """One pixel in: the output is the flipped kernel weighted by the channels of that pixel."""
    return (
        jnp.einsum("bc,hwco->bhwo", x[:, 0, 0], kernel[::-1, ::-1], **_ACCUMULATE).astype(x.dtype)
        + bias
    )


def _stride_1(x, kernel):
    """Convolve with stride 1, as one product of patches [..., k * k * C] and [k * k * C, O]."""
    k, _, channels, outputs = kernel.shape
    height, width = (side - k + 1 for side in x.shape[1:3])
    patches = jnp.concatenate(
        [x[:, i : i + height, j : j + width] for i in range(k) for j in range(k)], axis=-1
    )
    weights = kernel.reshape(k * k * channels, outputs)
    return jnp.matmul(patches, weights, **_ACCUMULATE).astype(x.dtype)


def _fit(x, height, width):
    """Crop x [B, height, width, C] to the size, or fill it up with zeros."""
    x = x[:, :height, :width]
    rows, columns = height - x.shape[1], width - x.shape[2]
    if rows or columns:
        x = jnp.pad(x, ((0, 0), (0, rows), (0, columns)) + ((0, 0),) * (x.ndim - 3))
    return x


_ACCUMULATE = {"preferred_element_type": jnp.float32}
