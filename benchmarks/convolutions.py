"""Time the gradients of the encoder's and the decoder's convolutions, computed either way.

    python -m benchmarks.convolutions depth=16 images=320 image_size=32 n=9

Prints one line of JSON. `wall` and `cpu` are milliseconds for one gradient, medians of n runs; the
ways take turns, so that all meet the same load. `cpu` sums over threads and suffers less from other
programs. `ratio` is the median over the turns of matmul's cpu time over the library's. `temporary`
is the memory in MiB that the compiled gradient works in.
"""

import json
import statistics
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from dreamer_jax.convolutions import convolution, transposed_convolution

DEFAULTS = {"depth": 16, "images": 320, "image_size": 32, "n": 9}
METHODS = ("library", "matmul")
MILLISECONDS = 1000
MEBIBYTES = 2**20


def parse(arguments):
    """Read name=value arguments into a copy of DEFAULTS."""
    settings = dict(DEFAULTS)
    for argument in arguments:
        name, _, value = argument.partition("=")
        if name not in settings or not value.isdecimal() or int(value) == 0:
            raise SystemExit(f"got {argument!r}, expected NAME=POSITIVE_INTEGER, {list(settings)}")
        settings[name] = int(value)
    if settings["image_size"] not in (32, 64):
        raise SystemExit(f"got image_size={settings['image_size']}, expected 32 or 64")
    return settings


def make_layers(rng, kernel_sizes, channels):
    """Draw a kernel and a bias for each layer, as wide as keeps the scale of the features."""
    layers = []
    for k, inputs, outputs in zip(kernel_sizes, channels[:-1], channels[1:], strict=True):
        kernel = rng.normal(0, (k * k * inputs) ** -0.5, (k, k, inputs, outputs))
        layers.append((jnp.float32(kernel), jnp.zeros(outputs, jnp.float32)))
    return layers


def encoder_loss(layers, images, method):
    """Sum of squares of the features of images [B, height, width, 3]."""
    x = images.astype(jnp.float32) / 255 - 0.5
    for kernel, bias in layers:
        x = convolution(x, kernel, bias, relu=True, method=method)
    return jnp.square(x).sum()


def decoder_loss(arguments, images, method):
    """Squared error of the images decoded from features [B, 32 depth]."""
    layers, features = arguments
    x = features[:, None, None]
    for kernel, bias in layers[:-1]:
        x = transposed_convolution(x, kernel, bias, relu=True, method=method)
    x = transposed_convolution(x, *layers[-1], method=method)
    return jnp.square(x - (images.astype(jnp.float32) / 255 - 0.5)).sum()


def compare(loss, arguments, images, n):
    """Time the gradient of a loss computed by each method, in turns."""
    gradients = {
        method: jax.jit(lambda a, i, method=method: jax.grad(loss)(a, i, method))
        .lower(arguments, images)
        .compile()
        for method in METHODS
    }
    for gradient in gradients.values():
        jax.block_until_ready(gradient(arguments, images))
    wall, cpu = {method: [] for method in METHODS}, {method: [] for method in METHODS}
    for _ in range(n):
        for method, gradient in gradients.items():
            wall_start, cpu_start = time.perf_counter(), time.process_time()
            jax.block_until_ready(gradient(arguments, images))
            cpu[method].append((time.process_time() - cpu_start) * MILLISECONDS)
            wall[method].append((time.perf_counter() - wall_start) * MILLISECONDS)
    ratios = [b / a for a, b in zip(cpu["library"], cpu["matmul"], strict=True)]
    return {
        "wall": {method: round(statistics.median(times), 2) for method, times in wall.items()},
        "cpu": {method: round(statistics.median(times), 2) for method, times in cpu.items()},
        "ratio": round(statistics.median(ratios), 3),
        "temporary": {
            method: round(gradient.memory_analysis().temp_size_in_bytes / MEBIBYTES, 1)
            for method, gradient in gradients.items()
        },
    }


def main():
    settings = parse(sys.argv[1:])
    depth, size = settings["depth"], settings["image_size"]
    layers = {32: 3, 64: 4}[size]
    widths = [depth * 2**layer for layer in range(layers)]
    rng = np.random.default_rng(0)
    images = jnp.asarray(rng.integers(0, 256, (settings["images"], size, size, 3), np.uint8))
    features = jnp.float32(rng.normal(size=(settings["images"], 32 * depth)))
    encoder = make_layers(rng, [4] * layers, [3, *widths])
    decoder = make_layers(
        rng, {32: [5, 6, 6], 64: [5, 5, 6, 6]}[size], [32 * depth, *widths[-2::-1], 3]
    )
    print(
        json.dumps(
            {
                **settings,
                "device": jax.devices()[0].device_kind,
                "jax": jax.__version__,
                "encoder": compare(encoder_loss, encoder, images, settings["n"]),
                "decoder": compare(decoder_loss, (decoder, features), images, settings["n"]),
            }
        )
    )


if __name__ == "__main__":
    main()
