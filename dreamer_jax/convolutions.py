"""Stride-2 convolutions and transposed convolutions, as library calls or as matrix products.

XLA's CPU backend is slow at strided and transposed convolutions, and slowest at their gradients;
the same sums arranged as matrix products take a fraction of the time. On NVIDIA cards they do too,
above all for populations, whose convolutions are grouped ones there (benchmarks/RESULTS.md). Both
layers have two ways to be computed and one definition of their parameters, so that a tree trained
on one kind of device runs on another.

Every window has stride 2 and no padding ("VALID"). In the shapes below k is the side of the
kernel, C the input channels, O the output channels, and "..." any number of batch axes.
"""

import functools
import math
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

Method = Literal["library", "matmul"]

_DIMENSIONS = ("NHWC", "HWIO", "NHWC")
_IN_BOUNDS = "promise_in_bounds"


def default_method() -> Method:
    """The faster method on the default device: "matmul" on CPUs and NVIDIA cards."""
    return "matmul" if jax.default_backend() in ("cpu", "gpu") else "library"


def convolution(x, kernel, bias, *, relu: bool = False, method: Method | None = None):
    """Convolve with stride 2: an image of side n becomes one of side (n - k) // 2 + 1.

    The layer of `flax.linen.Conv(O, (k, k), strides=2, padding="VALID")`.

    Args:
      x: float [..., height, width, C]; its type is the type of the computation and of the result.
      kernel: [k, k, C, O], cast to the type of x.
      bias: [O], cast to the type of x.
      relu: whether negative sums become 0.
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
    return _over_batch(compute, x, kernel, bias, relu)


def transposed_convolution(x, kernel, bias, *, relu: bool = False, method: Method | None = None):
    """Convolve transposed with stride 2: an image of side n becomes one of side 2 (n - 1) + k.

    The layer of `flax.linen.ConvTranspose(O, (k, k), strides=2, padding="VALID")`: kernel row i of
    input row m adds to output row 2 m + k - 1 - i.

    Args:
      x: float [..., height, width, C]; its type is the type of the computation and of the result.
      kernel: [k, k, C, O], cast to the type of x; k is at least 2.
      bias: [O], cast to the type of x.
      relu: whether negative sums become 0.
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
    else:
        compute = _matmul_transposed_convolution
    return _over_batch(compute, x, kernel, bias, relu)


def arrange(images, *, method: Method | None = None):
    """Lay images out in memory as the method reads them; the array itself is the same.

    Transposing images is work at the two ends of a network only: done here once, on bytes, it
    serves the first layer and `image_distance` alike.

    Args:
      images: uint8 [..., height, width, 3].
      method: as for `convolution`.

    Returns:
      The images, with the batch axes last in memory where the method is "matmul".
    """
    if _resolved("arrange", method) == "library":
        return images
    rows = images.reshape(-1, *images.shape[-3:]).swapaxes(0, 1)
    # A loop, since XLA fuses nothing across one: the layers that follow would gather from the
    # images as they were.
    rows = lax.map(lambda row: row.transpose(1, 2, 0), rows)
    return rows.transpose(3, 0, 1, 2).reshape(images.shape)


def image_distance(prediction, images, *, method: Method | None = None):
    """Compute half the squared distance of predicted and true images, summed over pixels.

    Args:
      prediction: float32 [..., height, width, 3], about [-0.5, 0.5]; the output of
        `transposed_convolution`.
      images: uint8 [..., height, width, 3], best laid out by `arrange`.
      method: as for `convolution`.

    Returns:
      float32 [...]; no gradient reaches the images.
    """
    if _resolved("image_distance", method) == "library":
        return 0.5 * ((prediction - normalise_image(images)) ** 2).sum((-3, -2, -1))
    flat = (_batch_last(x.reshape(-1, *x.shape[-3:])) for x in (prediction, images))
    return 0.5 * (_error(*flat) ** 2).sum((0, 1, 2)).reshape(prediction.shape[:-3])


def normalise_image(images):
    """uint8 [..., height, width, 3] -> float32 in [-0.5, 0.5]."""
    return images.astype(jnp.float32) / 255.0 - 0.5


def _resolved(name, method):
    """Return the method to use; raise if there is no such method."""
    if method is None:
        return default_method()
    if method not in ("library", "matmul"):
        raise ValueError(f"{name}: got method {method!r}, expected 'library', 'matmul' or None")
    return method


def _check(name, x, kernel, bias, method):
    """Raise if the arguments do not fit one another; return the method to use."""
    method = _resolved(name, method)
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


def _over_batch(compute, x, kernel, bias, relu):
    """Call `compute` with the batch axes of x as one, and all arguments of x's type."""
    batch = x.shape[:-3]
    x = x.reshape(math.prod(batch), *x.shape[-3:])
    out = compute(x, kernel.astype(x.dtype), bias.astype(x.dtype), relu)
    return out.reshape(*batch, *out.shape[1:])


def _library_convolution(x, kernel, bias, relu):
    x = lax.conv_general_dilated(x, kernel, (2, 2), "VALID", dimension_numbers=_DIMENSIONS) + bias
    return jax.nn.relu(x) if relu else x


def _library_transposed_convolution(x, kernel, bias, relu):
    x = lax.conv_transpose(x, kernel, (2, 2), "VALID", dimension_numbers=_DIMENSIONS) + bias
    return jax.nn.relu(x) if relu else x


def _matmul_convolution(x, kernel, bias, relu):
    return _batch_first(_contracting_layer(relu, _batch_last(x), kernel, bias))


def _matmul_transposed_convolution(x, kernel, bias, relu):
    # The transposed convolution is the adjoint of the convolution with this kernel, [k, k, O, C].
    kernel = kernel[::-1, ::-1].swapaxes(2, 3)
    return _batch_first(_expanding_layer(relu, _batch_last(x), kernel, bias))


# Below, arrays are [channels, height, width, B]. With the batch axis last, the pixels of a window
# are gathered in long contiguous runs whatever the stride, and the result is already the operand
# of a matrix product. Between two layers the change of axes costs nothing: XLA keeps the layout.
#
# Both layers and all their gradients are made of three operations on a large array (side n) and a
# small one (side m = (n - k) // 2 + 1), joined by a kernel [k, k, large channels, small channels]:
#   _contract   large, kernel -> small    the convolution, or the transposed one's input gradient
#   _expand     small, kernel -> large    the transposed convolution, or the other's input gradient
#   _correlate  large, small -> kernel    the kernel's gradient in both
# All three return their sums in the type they were accumulated in.


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _contracting_layer(relu, large, kernel, bias):
    small = _contract(large, kernel) + bias[:, None, None, None]
    return _rectified(relu, small).astype(large.dtype)


def _contracting_layer_forward(relu, large, kernel, bias):
    small = _contracting_layer(relu, large, kernel, bias)
    return small, (large, kernel, small)


def _contracting_layer_backward(relu, saved, gradient):
    large, kernel, small = saved
    gradient = _unrectified(relu, small, gradient)
    gradients = (
        _expand(gradient, kernel, *large.shape[1:3]),
        _correlate(large, gradient, kernel.shape[0]),
        _sum_by_channel(gradient),
    )
    return tuple(each.astype(large.dtype) for each in gradients)


_contracting_layer.defvjp(_contracting_layer_forward, _contracting_layer_backward)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _expanding_layer(relu, small, kernel, bias):
    height, width = (2 * (side - 1) + kernel.shape[0] for side in small.shape[1:3])
    large = _expand(small, kernel, height, width)
    return _rectified(relu, _add_by_channel(large, bias.__getitem__)).astype(small.dtype)


def _expanding_layer_forward(relu, small, kernel, bias):
    large = _expanding_layer(relu, small, kernel, bias)
    return large, (small, kernel, large)


def _expanding_layer_backward(relu, saved, gradient):
    small, kernel, large = saved
    gradient = _unrectified(relu, large, gradient)
    gradients = (
        *_contract_and_correlate(gradient, kernel, small),
        _sum_by_channel(gradient),
    )
    return tuple(each.astype(small.dtype) for each in gradients)


_expanding_layer.defvjp(_expanding_layer_forward, _expanding_layer_backward)


def _rectified(relu, x):
    return jnp.maximum(x, 0) if relu else x


def _unrectified(relu, x, gradient):
    """Compute the gradient of `_rectified`'s argument from that of its result x."""
    return jnp.where(x > 0, gradient, 0) if relu else gradient


def _contract(large, kernel):
    return _over_windows(large, kernel.shape[0], kernel=kernel)[0]


def _expand(small, kernel, height, width):
    windows = _product(_rows(kernel, 3), _rows(small, 1))
    return _overlap_add(windows.reshape(*kernel.shape[:3], *small.shape[1:]), height, width)


def _correlate(large, small, k):
    return _over_windows(large, k, small=small)[1]


def _contract_and_correlate(large, kernel, small):
    return _over_windows(large, kernel.shape[0], kernel=kernel, small=small)


def _over_windows(large, k, kernel=None, small=None):
    """Compute `_contract` where a kernel is given and `_correlate` where a small array is.

    A row of windows at a time: it stays in the cache, and all of them are k²/4 times `large`.
    """
    channels = large.shape[0]
    rows, columns = ((side - k) // 2 + 1 for side in large.shape[1:3])
    if kernel is not None:
        # In the order of the windows. The barrier keeps the transpose out of the product, which
        # is faster on a matrix that is laid out so.
        matrix = lax.optimization_barrier(_rows(kernel.transpose(1, 2, 0, 3), 3).T)
    if small is not None:
        type_of_sums = jnp.promote_types(small.dtype, jnp.float32)
        total = jnp.zeros((k * channels * k, small.shape[0]), type_of_sums)

    def add_row(total, row):
        windows = _windows(large, k, row)
        if small is not None:
            total += _product(windows, _rows(lax.dynamic_index_in_dim(small, row, 1, False), 1).T)
        return total, None if kernel is None else _product(matrix, windows)

    start = None if small is None else total
    total, contracted = lax.scan(add_row, start, jnp.arange(rows))  # type: ignore[arg-type]
    if small is not None:
        total = total.reshape(k, channels, k, small.shape[0]).transpose(2, 0, 1, 3)
    if kernel is not None:
        contracted = contracted.reshape(rows, kernel.shape[3], columns, large.shape[3]).swapaxes(
            0, 1
        )
    return contracted, total


def _sum_by_channel(x):
    # As a product, since XLA would lay out the operand of a sum anew, batch axis first.
    x = _rows(x, 1)
    return _product(x, jnp.ones(x.shape[1], x.dtype))


def _rows(x, axes):
    """Reshape x to a matrix whose rows are the first `axes` axes."""
    return x.reshape(math.prod(x.shape[:axes]), math.prod(x.shape[axes:]))


def _product(a, b):
    return jnp.matmul(a, b, preferred_element_type=jnp.promote_types(a.dtype, jnp.float32))


def _windows(large, k, row):
    """Copy a row of the k x k windows at stride 2 of [C, n, n, B], as a matrix [k C k, m B].

    Its rows are numbered by a pixel's column in the window, its channel, and its row in the window.
    """
    across = 2 * ((large.shape[2] - k) // 2) + 1
    size = (large.shape[0], k, across, large.shape[3])

    # A loop of copies: a gather of all k x k pixels would work out the place of every number.
    def column(number):
        return lax.dynamic_slice(large, (0, 2 * row, number, 0), size)[:, :, ::2]

    return _rows(lax.map(column, jnp.arange(k)), 3)


def _overlap_add(windows, height, width):
    """Add up windows [k, k, C, m, m, B] where they lie in [C, height, width, B].

    The adjoint of `_windows`. In each direction a pixel lies in at most ceil(k / 2) windows.
    """
    k, (windows_down, windows_across) = windows.shape[0], windows.shape[3:5]
    windows = windows.transpose(2, 0, 1, 3, 4, 5)
    if (windows_down, windows_across, height, width) == (1, 1, k, k):
        return windows[:, :, :, 0, 0]
    total: Any = 0
    for first_row in range(0, k, 2):
        row, down, in_row = _covering(first_row, k, windows_down, height)
        for first_column in range(0, k, 2):
            column, across, in_column = _covering(first_column, k, windows_across, width)
            pixels = windows.at[:, row[:, None], column, down[:, None], across].get(mode=_IN_BOUNDS)
            total += jnp.where((in_row[:, None] & in_column)[:, :, None], pixels, 0)
    return total


def _covering(first, k, windows, size):
    """Find, for each of `size` pixels in a line, the window in which it is number `first`.

    That is for even pixels; odd ones are number `first + 1`. Returns the pixel's number in its
    window, the number of the window, and whether there is such a window: where not, both are 0.
    """
    pixel = np.arange(size)
    number = first + pixel % 2
    window = (pixel - number) // 2
    present = (number < k) & (window >= 0) & (window < windows)
    return np.where(present, number, 0), np.where(present, window, 0), present


def _add_by_channel(x, addend):
    """Add addend(c) to each channel c of [C, height, width, B], in place.

    A loop, since XLA fuses nothing across one. Without it the backward pass would compute what
    x is made of anew for every window that a pixel is in.
    """
    return lax.fori_loop(0, x.shape[0], lambda c, x: x.at[c].add(addend(c).astype(x.dtype)), x)


@jax.custom_vjp
def _error(prediction, images):
    """Compute prediction - normalise_image(images), both [C, height, width, B]."""
    return _add_by_channel(prediction, lambda c: -normalise_image(images[c]))


_error.defvjp(lambda *arguments: (_error(*arguments), None), lambda _, gradient: (gradient, None))


def _batch_last(x):
    """Reorder [B, height, width, C] as [C, height, width, B]."""
    return x.transpose(3, 1, 2, 0)


def _batch_first(x):
    """Reorder [C, height, width, B] as [B, height, width, C]."""
    return x.transpose(3, 1, 2, 0)
